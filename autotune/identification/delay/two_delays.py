"""Two delays, x''(t) + a x(t - h_1) = b u(t - h_2): Example 3 of Ollivier, Moutaouakil and Sadik (2007).

With f(t) = 1 - cos(2 pi (t - T_1)/L), whose shifts are sums of 1, cos and sin, every interval gives

    b I_{u,f} + b sin(2 pi h_2/L) I_{u,sin} - a I_{x,f} - a sin(2 pi h_1/L) I_{x,sin} = (2 pi/L)^2 I_{x,cos}

up to second order in the delays. Misprint of the paper: its line swaps a and b and lacks the 2 pi. The signals are
shifted by the delays found and the step is repeated; at the fixed point the sines are zero and the equation exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError, InputError
from autotune.identification.delay.modulated_integrals import Interval
from autotune.recording import Recording


@dataclass(frozen=True, kw_only=True)
class TwoDelays:
    """Estimates of x''(t) + a x(t - h_1) = b u(t - h_2), and the steps taken to the fixed point."""

    a: float
    b: float
    h1_s: float
    h2_s: float
    iterations: int


def two_delays(
    recording: Recording,
    intervals: Sequence[Interval],
    *,
    start_s: tuple[float, float] = (0.0, 0.0),
    iterations: int = 30,
) -> TwoDelays:
    """Estimate a, b and both delays by modulating functions over intervals of one length.

    Parameters
    ----------
    recording : Recording
        u and y, linear between rows, from the first interval's beginning less the delays on.
    intervals : sequence of (float, float)
        (T_1, T_2) [s], all of one length, at least four.
    start_s : (float, float)
        Starting values of h_1 and h_2 [s].
    iterations : int
        Largest number of steps.

    Raises
    ------
    InputError
        Fewer than four intervals, or of unequal lengths.
    IdentificationError
        The iteration left the record, or the gains vanish.

    Notes
    -----
    For a periodic output the delays are defined up to its period. Noise on y stands in the regressors: a and b are
    biased towards zero as it grows (Table 2).

    References
    ----------
    Example 3 and Table 2.
    """
    lengths = np.array([T_2 - T_1 for T_1, T_2 in intervals])
    if lengths.size < 4 or np.ptp(lengths) > 1e-9 * lengths.max():
        raise InputError(f"{lengths.size} intervals", where="intervals", remedy="give at least four, all of one length")
    recording.require_finite()
    L = float(lengths[0])
    s = np.linspace(0.0, 1.0, max(64, round(L / recording.sample_time_s)) + 1)
    starts = np.array([T_1 for T_1, _ in intervals])
    omega = 2.0 * np.pi / L
    weights = np.full(s.size, L / (s.size - 1))
    weights[[0, -1]] *= 0.5
    f = weights * (1.0 - np.cos(2.0 * np.pi * s))
    sine = weights * np.sin(2.0 * np.pi * s)
    # L^-2 I_{x,f''}, from rows that stay where they are
    target = omega**2 * _shifted(recording, recording.y, starts, L * s, 0.0) @ (weights * np.cos(2.0 * np.pi * s))
    h1, h2 = start_s
    a = b = 0.0
    count = 0
    while count < iterations:
        count += 1
        x = _shifted(recording, recording.y, starts, L * s, h1)
        u = _shifted(recording, recording.u, starts, L * s, h2)
        matrix = np.column_stack([u @ f, u @ sine, -(x @ f), -(x @ sine)])
        b, b_sine, a, a_sine = np.linalg.lstsq(matrix, target, rcond=None)[0]
        if a == 0.0 or b == 0.0:
            raise IdentificationError("a gain vanishes", where=recording.name, remedy="the record excites too little")
        steps = np.arctan([a_sine / a, b_sine / b]) / omega  # the arctangent keeps a step below a quarter of L
        h1, h2 = h1 + float(steps[0]), h2 + float(steps[1])
        if np.max(np.abs(steps)) < 1e-7 * L:
            break
    return TwoDelays(a=float(a), b=float(b), h1_s=h1, h2_s=h2, iterations=count)


def _shifted(recording: Recording, values: FloatArray, starts: FloatArray, offsets: FloatArray, h: float) -> FloatArray:
    """Return values(t - h) on every interval, shape (intervals, len(offsets))."""
    at = starts[:, None] + offsets - h
    slack = recording.sample_time_s
    if at.min() < recording.t[0] - slack or at.max() > recording.t[-1] + slack:
        raise IdentificationError(
            f"with a delay of {h:.4g} s the intervals leave the record",
            where=recording.name,
            remedy="start nearer to the delays or take shorter intervals",
        )
    return np.interp(at, recording.t, values)
