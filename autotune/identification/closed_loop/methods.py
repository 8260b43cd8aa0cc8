"""Every closed-loop method under its name, on signals of any number of inputs and outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.signal import lfilter

from autotune.arrays import FloatArray
from autotune.controller import DiscreteController
from autotune.errors import IdentificationError, InputError
from autotune.identification.closed_loop.order import choose_order, default_past_window, fit_order
from autotune.identification.closed_loop.refit import refit_inputs
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.identification.closed_loop.subspace_direct import pbsid_opt, ssarx
from autotune.identification.closed_loop.subspace_indirect import (
    Instrument,
    controller_markov_parameters,
    indirect_subspace,
)
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


#: What of :class:`Windows` a method takes; all four where it is not named.
_TAKES = {
    "prediction-error": ("p",),
    **dict.fromkeys(("van-overschee", "oku-tanaka", "ort", "ssarx", "pbsid"), ("f", "p")),
}


@dataclass(frozen=True, kw_only=True)
class Windows:
    """What a subspace method looks at, in the papers' letters; chosen where it is absent.

    Attributes
    ----------
    f, p : int, optional
        Rows of the future and of the past; a few more than the loop's order when absent.
    n_cl : int, optional
        Order of the loop, of the indirect method; n plus the controller's order when absent.
    Psi : {"r", "r and y"}, optional
        Instrument of the indirect method, R_p or [R_p; Y_p], which it is when absent.

    Raises
    ------
    InputError
        A number that is not positive.
    """

    f: int | None = None
    p: int | None = None
    n_cl: int | None = None
    Psi: Literal["r", "r and y"] | None = None

    def __post_init__(self) -> None:
        for name in ("f", "p", "n_cl"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} = {value}", where="windows", remedy="it counts rows or states: at least 1")

    def require_taken_by(self, method: Method) -> None:
        """Refuse what a method has no use for."""
        takes = _TAKES.get(method, ("f", "p", "n_cl", "Psi"))
        for name in ("f", "p", "n_cl", "Psi"):
            if getattr(self, name) is not None and name not in takes:
                remedy = f"it takes {' and '.join(takes)}"
                raise InputError(f"{name} is none of its settings", where=f"method {method}", remedy=remedy)


CHOSEN = Windows()


def closed_loop_model(
    u: FloatArray,
    y: FloatArray,
    *,
    method: Method = "prediction-error",
    order: int | None = None,
    r: FloatArray | None = None,
    controller_markov: FloatArray | None = None,
    windows: Windows = CHOSEN,
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
    windows : Windows
        f, p, n_cl and Psi.
    sample_time_s : float
        Sample time [s].

    Returns
    -------
    InnovationModel

    Raises
    ------
    InputError
        A method that needs r without it, or a window that it does not take.
    IdentificationError
        The record is too short, or r does not excite the loop.
    """
    windows.require_taken_by(method)
    scale_u, scale_y = np.std(u, axis=0), np.std(y, axis=0)
    if not (np.all(scale_u > 0.0) and np.all(scale_y > 0.0)):
        raise IdentificationError("a signal does not move", remedy="move the set-point or add a dither")
    u_1, y_1 = (u - u.mean(axis=0)) / scale_u, (y - y.mean(axis=0)) / scale_y
    if order is None:
        order = choose_order(u_1, y_1).estimate.model.order
    model = _direct(u_1, y_1, order, method, windows) if method not in NEED_R else None
    if model is None:
        if r is None:
            raise InputError(
                f"method {method} needs r, what was added to the controller's output",
                where="closed loop",
                remedy="record r, or take a direct method: prediction-error, pbsid, ssarx",
            )
        r_1 = (r - r.mean(axis=0)) / scale_u
        markov = None if controller_markov is None else controller_markov * scale_y / scale_u[:, None]
        model = _by_excitation(r_1, u_1, y_1, order, method, markov, windows)
    return model.in_units(scale_u, scale_y, sample_time_s)


def _direct(u: FloatArray, y: FloatArray, order: int, method: Method, windows: Windows) -> InnovationModel:
    p = windows.p or default_past_window(len(u), u.shape[1] + y.shape[1])
    f = windows.f or min(p, max(10, order + 2))
    match method:
        case "pbsid":
            return pbsid_opt(u, y, order, p=p, f=f)
        case "ssarx":
            return ssarx(u, y, order, p=p, f=f)
        case _:
            return fit_order(u, y, order, p=windows.p).model


def _by_excitation(
    r: FloatArray,
    u: FloatArray,
    y: FloatArray,
    order: int,
    method: Method,
    markov: FloatArray | None,
    windows: Windows,
) -> InnovationModel:
    f, p = windows.f or 2 * order + _BEYOND, windows.p
    if method in NEED_CONTROLLER and (markov is None or len(markov) < f):
        markov = controller_markov_parameters(r, u, y, f)[0]
    match method:
        case "oku-tanaka":
            return oku_tanaka(r, u, y, order, f=f, p=p)
        case "ort":
            return orthogonal_decomposition(r, u, y, order, f=f, p=p)
    assert markov is not None
    if method == "van-overschee":
        return van_overschee_de_moor(r, u, y, order, controller_markov=markov, f=f, p=p)
    instrument: Instrument = windows.Psi or "r and y"
    found = indirect_subspace(
        r, u, y, order, controller_markov=markov, f=f, p=p, loop_order=windows.n_cl, instrument=instrument
    )
    return refit_inputs(found, u, y) if method == "indirect-refitted" else found


def markov_of(controller: DiscreteController, count: int) -> FloatArray:
    """Return the first Markov parameters of a sampled controller, shape (count, 1, 1).

    Parameters
    ----------
    controller : DiscreteController
        One input, one output.
    count : int
        How many, the one of no lag counted.
    """
    impulse = np.zeros(count)
    impulse[0] = 1.0
    return np.asarray(lfilter(controller.num, controller.den, impulse), dtype=np.float64)[:, None, None]
