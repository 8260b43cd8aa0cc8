"""B and D again, from the prediction errors: the remedy for methods that estimate A, C and K well and B badly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.lagged import BLOCK_ROWS, least_squares, triangle
from autotune.identification.closed_loop.predictor_sweep import innovations
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.identification.closed_loop.subspace_direct import with_stable_predictor


def refit_inputs(model: InnovationModel, u: FloatArray, y: FloatArray, *, feedthrough: bool = False) -> InnovationModel:
    """Return the model with B, D, initial state and a load refitted by linear least squares on its prediction errors.

    Parameters
    ----------
    model : InnovationModel
        A, C and K are kept (K is replaced first where its predictor is not stable).
    u, y : (N, n_u), (N, n_y) arrays
        Command and measurement about any operating point: a load is fitted as well.
    feedthrough : bool
        Estimate D; otherwise it is zero.

    Returns
    -------
    InnovationModel
        With B, D and the innovations' covariance of the refit.

    Notes
    -----
    The one-step predictor is linear in B, D and x(0) once A, C and K are given; in closed loop the estimate is
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
        if feedthrough:
            columns += [_through(model, signal, o) for o in range(n_y)]
    base = innovations(
        _state_map(model, np.zeros((n, 0))), _output_map(model, 0), np.zeros(n), np.zeros((len(y), 0)), y
    )
    R = np.zeros((0, len(columns) + 1))
    for at in range(0, len(y), BLOCK_ROWS):
        part = [column[at : at + BLOCK_ROWS].ravel() for column in [*columns, base]]
        R = triangle(np.vstack([R, np.stack(part, axis=1)]))
    theta = -least_squares(R[:, :-1], R[:, -1])
    rest = base + sum(column * value for column, value in zip(columns, theta, strict=True))
    by_input = theta[first:].reshape(n_u, -1)
    return replace(
        model,
        B=by_input[:, :n].T.copy(),
        D=by_input[:, n:].T.copy() if feedthrough else np.zeros((n_y, n_u)),
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


def _through(model: InnovationModel, u: FloatArray, output: int) -> FloatArray:
    """Return the change of the innovations that a unit feedthrough to one output makes."""
    y = np.zeros((len(u), len(model.C)))
    y[:, output] = -u[:, 0]
    nothing = np.zeros((model.order, 0))
    errors: FloatArray = innovations(
        _state_map(model, nothing), _output_map(model, 0), np.zeros(model.order), np.zeros((len(u), 0)), y
    )
    return errors
