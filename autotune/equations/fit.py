"""Retuning: the parameters of a model, and of its extensions, that explain recordings best, beliefs counted.

Gauss-Newton with Levenberg's damping on the readings' errors over the noise and on the parameters' distance from
the prior of them, see :mod:`autotune.equations.descent`; on short windows first where the way is long.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.equations.descent import Descent
from autotune.equations.fit_data import Fitted, data_of
from autotune.equations.parameter_scales import values_of
from autotune.equations.sensitivity import Windows
from autotune.equations.simulate import Compiled
from autotune.errors import InputError
from autotune.recording import Recording

#: Windows that a recording is cut into, one fit after the other, each with this many rows at least.
SHORT_TO_LONG, LEAST_ROWS = (32, 8, 2, 1), 24
#: A longer window that leaves this many times the error of the shorter ones has lost its way.
LOST = 30.0
#: Rows per state, and one more, that a window has at least where a horizon is stated: the plant runs away.
ROWS_PER_STATE = 4


def fit(
    compiled: Compiled,
    recordings: Sequence[Recording],
    *,
    windows: Sequence[Windows] | None = None,
    known: Sequence[Windows] | None = None,
    horizon_s: float | None = None,
    z: FloatArray | None = None,
    free: BoolArray | None = None,
    iterations: int = 30,
) -> Fitted:
    """Fit a model's parameters on given windows.

    Parameters
    ----------
    compiled : Compiled
        The model with its extensions.
    recordings : sequence of Recording
        What was measured; rows whose y is no number do not count.
    windows : sequence of Windows, optional
        One per recording; by default windows of a length, with start states that fit them.
    known : sequence of Windows, optional
        States that an earlier fit found, on its own windows, for windows of a length.
    horizon_s : float, optional
        That length [s]; by default the model's, or one free run per recording.
    z : (P,) array, optional
        Where to begin; the nominal values by default.
    free : (P,) bool array, optional
        Which parameters are retuned; by default all with a spread.
    iterations : int
        Gauss-Newton steps at most.

    Returns
    -------
    Fitted
        A local minimum. Standard deviations hold to first order and take the residual for white noise.

    Raises
    ------
    InputError
        A recording without readings or a missing column, or a nominal model that runs away.
    """
    z = np.zeros(len(compiled.parameters)) if z is None else np.array(z, dtype=np.float64)
    spread = np.array([p.spread for p in compiled.parameters])
    which = np.flatnonzero((spread > 0.0) & (np.ones(spread.size, dtype=bool) if free is None else free))
    length = compiled.model.horizon_s if horizon_s is None else horizon_s
    p = values_of(compiled, z)
    none = [None] * len(recordings)
    each = zip(recordings, windows or none, known or none, strict=True)
    data = [data_of(compiled, one, p, length, at, before) for one, at, before in each]
    state = Descent(compiled, data, which, z)
    for k in range(iterations):
        rests = state.step()
        if (rests or k % 2) and k + 1 < iterations and state.restart_windows():
            continue
        if rests:
            break
    return state.fitted()


def retune(
    compiled: Compiled,
    recordings: Sequence[Recording],
    *,
    longest_s: float = np.inf,
) -> Fitted:
    """Retune a model on short windows first, then on longer ones up to the whole free run.

    Parameters
    ----------
    compiled, recordings
        As for :func:`fit`.
    longest_s : float
        Length of the longest windows [s], where that is not to be the whole recording.

    Returns
    -------
    Fitted
        On the longest windows that do not run away: free start states at many windows forgive wrong parameters
        enough to lead to the right ones, from which a free run converges.

    Raises
    ------
    InputError
        As :func:`fit`.
    """
    whole = max(float(one.t[-1] - one.t[0]) for one in recordings)
    longest = min(compiled.model.horizon_s or np.inf, longest_s, whole)
    rows = min(len(one) for one in recordings)
    few = ROWS_PER_STATE * (len(compiled.states) + 1)
    least = min(few, LEAST_ROWS) if compiled.model.horizon_s else LEAST_ROWS
    counts = [count for count in SHORT_TO_LONG if rows * longest / whole / count >= least]
    lengths = [longest / count for count in counts or [1]]
    found: Fitted | None = None
    for k, length in enumerate(lengths):
        z = None if found is None else found.z
        last = length >= whole
        try:
            new = fit(
                compiled, recordings, z=z, horizon_s=None if last else length,
                iterations=30 if k == len(lengths) - 1 else 12,
            )  # fmt: skip
        except InputError:
            if found is None:
                continue
            break
        if found is not None and new.noise_sd > LOST * found.noise_sd:
            break
        found = new
    if found is None:
        return fit(compiled, recordings)
    return found
