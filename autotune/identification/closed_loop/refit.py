"""B again, from the prediction errors: the remedy for methods that estimate A, C and K well and B badly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.lagged import BLOCK_ROWS, least_squares, triangle
from autotune.identification.closed_loop.predictor_sweep import innovations
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.identification.closed_loop.subspace_direct import with_stable_predictor


def refit_inputs(model: InnovationModel, u: FloatArray, y: FloatArray) -> InnovationModel:
    """Return the model with B, initial state and a load refitted by linear least squares on its prediction errors.

    D is zero: y is measured before its row's u acts.

    Parameters
    ----------
    model : InnovationModel
        A, C and K are kept (K is replaced first where its predictor is not stable).
    u, y : (N, n_u), (N, n_y) arrays
        Command and measurement about any operating point: a load is fitted as well.

    Returns
    -------
    InnovationModel
        With B and the innovations' covariance of the refit.

    Notes
    -----
    The one-step predictor is linear in B and x(0) once A, C and K are given; in closed loop the estimate is
    consistent where A and K are.
    """
    model = with_stable_predictor(model)
    n, n_u, n_y = model.order, u.shape[1], y.shape[1]
    delay = model.input_delay
    u, y = u[: len(u) - delay], np.ascontiguousarray(y[delay:])
    columns = [_response(model, np.zeros((n, 0)), np.zeros((len(y), 0)), np.eye(n)[i], len(y)) for i in range(n)]
    columns += [_response(model, load[:, None], np.ones((len(y), 1)), np.zeros(n), len(y)) for load in _loads(model)]
    first = len(columns)
    for q in range(n_u):
        signal = np.ascontiguousarray(u[:, q : q + 1])
        columns += [_response(model, np.eye(n)[:, i : i + 1], signal, np.zeros(n), len(y)) for i in range(n)]
    base = innovations(
        _state_map(model, np.zeros((n, 0))), _output_map(model, 0), np.zeros(n), np.zeros((len(y), 0)), y
    )
    R = np.zeros((0, len(columns) + 1))
    for at in range(0, len(y), BLOCK_ROWS):
        part = [column[at : at + BLOCK_ROWS].ravel() for column in [*columns, base]]
        R = triangle(np.vstack([R, np.stack(part, axis=1)]))
    theta = -least_squares(R[:, :-1], R[:, -1])
    rest = base + sum(column * value for column, value in zip(columns, theta, strict=True))
    return replace(
        model,
        B=theta[first:].reshape(n_u, n).T.copy(),
        D=np.zeros((n_y, n_u)),
        innovation_covariance=rest.T @ rest / max(len(y) - len(theta), 1),
    )


def _loads(model: InnovationModel) -> FloatArray:
    """Return the loads on the states that shift the predictions most, (n_y, n)."""
    F = model.A - model.K @ model.C
    return np.asarray(np.linalg.qr(np.linalg.solve(np.eye(model.order) - F.T, model.C.T))[0].T, dtype=np.float64)


def _state_map(model: InnovationModel, B: FloatArray) -> FloatArray:
    return np.hstack([model.A - model.K @ model.C, B, model.K, np.zeros((model.order, 1))])


def _output_map(model: InnovationModel, n_u: int) -> FloatArray:
    return np.hstack([model.C, np.zeros((len(model.C), n_u + 1))])


def _response(model: InnovationModel, B: FloatArray, u: FloatArray, x0: FloatArray, rows: int) -> FloatArray:
    """Return the change of the innovations that a B and an initial state make, y left out."""
    y = np.zeros((rows, len(model.C)))
    errors: FloatArray = innovations(_state_map(model, B), _output_map(model, u.shape[1]), x0, u, y)
    return errors
