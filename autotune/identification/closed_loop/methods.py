"""Every closed-loop method under its name, on signals of any number of inputs and outputs."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.signal import lfilter

from autotune.arrays import FloatArray
from autotune.controller import DiscreteController
from autotune.errors import IdentificationError, InputError
from autotune.identification.closed_loop.order import choose_order, default_past_window, fixed_order
from autotune.identification.closed_loop.refit import refit_inputs
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.identification.closed_loop.subspace_direct import pbsid_opt, ssarx
from autotune.identification.closed_loop.subspace_indirect import controller_markov_parameters, indirect_subspace
from autotune.identification.closed_loop.subspace_peers import (
    oku_tanaka,
    orthogonal_decomposition,
    van_overschee_de_moor,
)

#: ``indirect`` is the paper's own method, ``indirect-refitted`` the same with its weak step (B and D) done again.
Method: TypeAlias = Literal[
    "prediction-error", "indirect", "indirect-refitted", "van-overschee", "oku-tanaka", "ort", "ssarx", "pbsid"
]
METHODS: tuple[Method, ...] = get_args(Method)
#: Methods that need the excitation r, and of these the ones that need the controller.
NEED_R = ("indirect", "indirect-refitted", "van-overschee", "oku-tanaka", "ort")
NEED_CONTROLLER = ("indirect", "indirect-refitted", "van-overschee")
#: Lags looked back and ahead beyond the loop's order.
_BEYOND = 6


def closed_loop_model(
    u: FloatArray,
    y: FloatArray,
    *,
    method: Method = "prediction-error",
    order: int | None = None,
    r: FloatArray | None = None,
    controller_markov: FloatArray | None = None,
    window: int | None = None,
    sample_time_s: float = 1.0,
) -> InnovationModel:
    """Return the plant's model by one of the closed-loop methods.

    Parameters
    ----------
    u, y : (N, n_u), (N, n_y) arrays
        Command and measurement; means are removed.
    method : str
        One of :data:`METHODS`.
    order : int, optional
        Number of states; chosen by the Bayesian information criterion when absent.
    r : (N, n_u) array, optional
        What was added to the controller's output, u = r - C y; the indirect methods need it.
    controller_markov : (count, n_u, n_y) array, optional
        The controller's Markov parameters; computed from the data (Remark 4) when absent.
    window : int, optional
        Future window f (past window p of the direct methods); a few lags beyond the loop's order when absent.
    sample_time_s : float
        Sample time [s].

    Returns
    -------
    InnovationModel

    Raises
    ------
    InputError
        A method that needs r without it.
    IdentificationError
        The record is too short, or r does not excite the loop.
    """
    scale_u, scale_y = np.std(u, axis=0), np.std(y, axis=0)
    if not (np.all(scale_u > 0.0) and np.all(scale_y > 0.0)):
        raise IdentificationError("a signal does not move", remedy="move the set-point or add a dither")
    u_1, y_1 = (u - u.mean(axis=0)) / scale_u, (y - y.mean(axis=0)) / scale_y
    if order is None:
        order = choose_order(u_1, y_1).estimate.model.order
    model = _direct(u_1, y_1, order, method, window) if method not in NEED_R else None
    if model is None:
        if r is None:
            raise InputError(
                f"method {method} needs r, what was added to the controller's output",
                where="closed loop",
                remedy="record r, or take a direct method: prediction-error, pbsid, ssarx",
            )
        r_1 = (r - r.mean(axis=0)) / scale_u
        markov = None if controller_markov is None else controller_markov * scale_y / scale_u[:, None]
        model = _by_excitation(r_1, u_1, y_1, order, method, markov, window)
    return _in_units(model, scale_u, scale_y, sample_time_s)


def _direct(u: FloatArray, y: FloatArray, order: int, method: Method, window: int | None) -> InnovationModel:
    p = default_past_window(len(u), u.shape[1] + y.shape[1]) if window is None else window
    f = min(p, max(10, order + 2))
    match method:
        case "pbsid":
            return pbsid_opt(u, y, order, p=p, f=f)
        case "ssarx":
            return ssarx(u, y, order, p=p, f=f)
        case _:
            return fixed_order(u, y, order, p=window).model


def _by_excitation(
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    order: int,
    method: Method,
    markov: FloatArray | None,
    window: int | None,
) -> InnovationModel:
    f = window or 2 * order + _BEYOND
    if method in NEED_CONTROLLER and (markov is None or len(markov) < f):
        markov = controller_markov_parameters(r, u, y, f)[0]
    match method:
        case "oku-tanaka":
            return oku_tanaka(r, u, y, order, f=f)
        case "ort":
            return orthogonal_decomposition(r, u, y, order, f=f)
    assert markov is not None
    if method == "van-overschee":
        return van_overschee_de_moor(r, u, y, order, controller_markov=markov, f=f)
    found = indirect_subspace(r, u, y, order, controller_markov=markov, f=f).model
    return refit_inputs(found, u, y) if method == "indirect-refitted" else found


def _in_units(
    model: InnovationModel, scale_u: FloatArray, scale_y: FloatArray, sample_time_s: float
) -> InnovationModel:
    return InnovationModel(
        A=model.A,
        B=model.B / scale_u,
        C=model.C * scale_y[:, None],
        D=model.D * scale_y[:, None] / scale_u,
        K=model.K / scale_y,
        innovation_covariance=model.innovation_covariance * np.outer(scale_y, scale_y),
        sample_time_s=sample_time_s,
        input_delay=model.input_delay,
    )


def markov_of(controller: DiscreteController, count: int) -> FloatArray:
    """Return the first Markov parameters of a sampled controller, shape (count, 1, 1)."""
    impulse = np.zeros(count)
    impulse[0] = 1.0
    return np.asarray(lfilter(controller.num, controller.den, impulse), dtype=np.float64)[:, None, None]
