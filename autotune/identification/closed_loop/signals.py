"""From a recording to the signals of a closed-loop method, whatever their number, and where r enters the loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from autotune.arrays import FloatArray, is_constant
from autotune.controller import Controller, DiscreteController
from autotune.errors import InputError
from autotune.identification.closed_loop.control_law import check_law
from autotune.identification.closed_loop.methods import CHOSEN, NEED_R, Method, Windows, closed_loop_model, markov_of
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.recording import Recording

#: Markov parameters of a controller file that are handed on.
_MARKOV = 200


def model_of_recording(
    recording: Recording,
    *,
    method: Method,
    order: int | None = None,
    controller: Controller | None = None,
    more: tuple[Sequence[str], Sequence[str], Sequence[str]] = ((), (), ()),
    windows: Windows = CHOSEN,
) -> InnovationModel:
    """Return the plant's model by one of the closed-loop methods from a recording of the loop.

    Parameters
    ----------
    recording : Recording
        t, u, y; r as the set-point of u = C (r - y) or as what was added to the command, u = r - C y (the controller
        file tells which, without one the latter); a column ``dither`` was added to the command besides.
    method : str
        One of :data:`autotune.identification.closed_loop.methods.METHODS`.
    order : int, optional
        Number of states; chosen when absent.
    controller : Controller, optional
        With one input and one output; several controllers' laws are found from the data.
    more : three sequences of str
        Columns of further inputs, outputs and excitations.
    windows : Windows
        f, p, n_cl and Psi of the subspace methods.

    Returns
    -------
    InnovationModel

    Raises
    ------
    InputError
        A column that is not there, or that holds values that are not numbers.
    """
    from autotune.identification.closed_loop.gaps import usable_stretch

    for column in (name for names in more for name in names):
        _ = recording[column]  # names the columns that are there
    recording, _ = usable_stretch(recording)
    more_u, more_y, more_r = ([recording[name] for name in names] for names in more)
    u, y = np.column_stack([recording.u, *more_u]), np.column_stack([recording.y, *more_y])
    finite = np.all(np.isfinite(u)) and np.all(np.isfinite(y))
    if not finite:
        raise InputError("a column holds values that are not numbers", where=recording.name, remedy="leave it out")
    r, markov = None, None
    if method in NEED_R:
        r, markov = _excitation(recording, controller if u.shape[1] == y.shape[1] == 1 else None)
        r = np.column_stack([r, *more_r])
        if r.shape[1] != u.shape[1]:
            raise InputError(
                f"{u.shape[1]} inputs and {r.shape[1]} excitations",
                where=recording.name,
                remedy="name what was added to each further input by --more-r",
            )
    return closed_loop_model(
        u,
        y,
        method=method,
        order=order,
        r=r,
        controller_markov=markov,
        windows=windows,
        sample_time_s=recording.sample_time_s,
    )


def _excitation(recording: Recording, controller: Controller | None) -> tuple[FloatArray, FloatArray | None]:
    """Return what was added to the controller's output, and the controller's Markov parameters where it is known."""
    dither = recording.extra.get("dither")
    added = dither if dither is not None and np.all(np.isfinite(dither)) else None
    r = recording.extra.get("r")
    if controller is None:
        if added is None and r is None:
            raise InputError(
                "holds neither r nor a dither",
                where=recording.name,
                remedy="record what moved the loop, or take a direct method: prediction-error, pbsid, ssarx",
            )
        return added if added is not None and (r is None or is_constant(r)) else _plain(r, added), None
    law = check_law(controller, recording.u, recording.y, r, recording.sample_time_s, added=added)
    if law.contradicts:
        raise InputError(
            f"the controller file contradicts the data: {100 * law.beyond_rounding:.0f} % of the command's motion does "
            "not come from this law",
            where=recording.name,
            remedy="correct the file, or leave --controller away",
        )
    total = np.zeros(len(recording)) if added is None else added.copy()
    if r is not None:
        total += r if law.summation == "command" else _through(law.controller, r)
    return total, markov_of(law.controller, _MARKOV)


def _plain(r: FloatArray | None, added: FloatArray | None) -> FloatArray:
    assert r is not None
    return r if added is None else r + added


def _through(controller: DiscreteController, r: FloatArray) -> FloatArray:
    """Return C(q) r, begun at rest at the first set-point."""
    return np.asarray(lfilter(controller.num, controller.den, r - r[0]), dtype=np.float64)
