"""A fitted plant run freely under a recorded command, over the rows it was fitted to and over rows it has not seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import AutotuneError
from autotune.experiment.prediction import respond_sampled, sampled
from autotune.identification.delay.identify import identify_delay
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction
from autotune.recording import Recording

#: Part of a recording from which the rest is forecast.
SEEN = 2.0 / 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Forecast:
    """The last rows of a recording beside what the first ones make of them.

    Attributes
    ----------
    first : int
        The first row that was not seen.
    y : (N,) array
        The free run over all rows.
    seen, unseen : float
        Root mean square of the error over the rows that were fitted, and over the others, in the unit of y.
    """

    first: int
    y: FloatArray
    seen: float
    unseen: float


def free_run(plant: TransferFunction, recording: Recording, rows: int | None = None) -> FloatArray | None:
    """Return y of one free run of a plant under the recorded command, or None.

    The operating point and what was under way at the first row are fitted, nothing else is.

    Parameters
    ----------
    plant : TransferFunction
        What is run.
    recording : Recording
        N rows.
    rows : int, optional
        First rows of y that the operating point and the initial state are fitted to; all where not given.

    Returns
    -------
    (N,) array or None
        In the unit of y; None of uneven rows, of fewer than ten, or where the run leaves all bounds.
    """
    steps, y = np.diff(recording.t), recording.y
    T_s = float(np.median(steps))
    if y.size < 10 or float(np.max(np.abs(steps - T_s))) > 0.05 * T_s or not np.all(np.isfinite(recording.u)):
        return None
    num, den = sampled(plant, T_s)
    forced = respond_sampled(num, den, recording.u - recording.u[0])
    t = recording.t - recording.t[0]
    # what was under way at the first row dies away, or goes on, as the plant's own modes; one at 0 is a constant
    modes: list[FloatArray] = [np.ones(t.size)]
    for pole in (p for p in np.atleast_1d(plant.poles) if p.imag >= 0.0):
        mode: ComplexArray = np.exp(np.clip((pole * t).real, -50.0, 50.0)) * np.exp(1j * (pole * t).imag)
        modes += [mode.real, mode.imag] if pole.imag else [mode.real if pole else t]
    good = np.isfinite(y) & (np.arange(y.size) < (y.size if rows is None else rows))
    columns = np.column_stack(modes)
    scale = np.linalg.norm(columns[good], axis=0)
    scale[scale == 0.0] = 1.0
    if not np.all(np.isfinite(forced)) or not np.any(good):
        return None
    x = np.linalg.lstsq(columns[good] / scale, (y - forced)[good], rcond=1e-9)[0]
    return np.asarray(forced + columns / scale @ x, dtype=np.float64)


def share_explained(recording: Recording, simulated: FloatArray) -> float:
    """Return the fit in per cent, 100 (1 - |y - simulated| / |y - mean|).

    Parameters
    ----------
    recording : Recording
        N rows.
    simulated : (N,) array
        What is held against its y.
    """
    good = np.isfinite(recording.y)
    y = recording.y[good]
    spread = float(np.linalg.norm(y - np.mean(y)))
    return 100.0 * (1.0 - float(np.linalg.norm(y - simulated[good])) / (spread or 1.0))


def forecast(fit: PlantFit, recording: Recording) -> Forecast | None:
    """Return the last third of a recording as its first two thirds alone foretell it, or None.

    A plant of the fitted structure is fitted to the first rows anew, from no starting value, and run on without being
    told any later y: not one row of the last third has a part in it.

    Parameters
    ----------
    fit : PlantFit
        Its structure (order, integrator) is what is fitted.
    recording : Recording
        Rows in time.

    Returns
    -------
    Forecast or None
        None where the first rows do not determine the plant, where it has a zero, or where rows are uneven.
    """
    first = int(SEEN * len(recording))
    if len(fit.plant.num) > 1:
        return None
    try:
        model = identify_delay(recording.only(slice(first)), len(fit.plant.den) - 1, integrator=fit.integrating)
    except AutotuneError:
        return None
    y = free_run(model.transfer_function(), recording, first)
    if y is None:
        return None
    squares = (recording.y - y) ** 2
    seen, unseen = (math.sqrt(float(np.nanmean(part))) for part in (squares[:first], squares[first:]))
    return Forecast(first=first, y=y, seen=seen, unseen=unseen)
