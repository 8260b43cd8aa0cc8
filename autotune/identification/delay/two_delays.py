"""Two delays, x''(t) + a x(t - h_1) = b u(t - h_2): Example 3 of Ollivier, Moutaouakil and Sadik (2007).

With f(t) = 1 - cos(2 pi (t - T_1)/L), whose shifts are sums of 1, cos and sin, every interval gives

    b I_{u,f} + b sin(2 pi h_2/L) I_{u,sin} - a I_{x,f} - a sin(2 pi h_1/L) I_{x,sin} = (2 pi/L)^2 I_{x,cos}

up to second order in the delays. Misprint of the paper: its line swaps a and b and lacks the 2 pi. The signals are
shifted by the delays found and the step is repeated; at the fixed point the sines are zero and the equation exact.

The polish takes the noise into account: the equations are linear in y, so their errors under white noise have a
covariance that is known for given a and h_1, and generalised least squares weights them by it. No initial function is
needed, and the plant may be unstable. Windows with a harmonic or two of their own length tell more than f alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import IdentificationError, InputError
from autotune.identification.delay.modulated_integrals import Interval
from autotune.identification.delay.weighted_equations import Windows, minimise_weighted
from autotune.one_thread import on_one_thread
from autotune.recording import Recording

#: Samples of an interval in the polish, and harmonics of its length that modulate it besides.
_SAMPLES = 100
_HARMONICS = 2
#: Intervals in a record and their overlap, where none are given.
_LENGTHS, _OVERLAP = 8.0, 5
#: rows of an interval at least, and intervals at most, which are then spaced out over the record
_ROWS, _MOST = 16, 2000
#: Starting delays, in intervals, and how far below zero a fixed point may lie because of noise.
_STARTS = (0.0, 0.2, 0.4, 0.6)
_EARLY = 0.02
#: Condition of the scaled equations above which they leave something open.
_DETERMINED = 1e6


@dataclass(frozen=True, kw_only=True, eq=False)
class TwoDelays:
    """Estimates of x''(t) + a x(t - h_1) = b u(t - h_2).

    Attributes
    ----------
    a, b, h1_s, h2_s : float
        Coefficients and delays [s].
    covariance : (4, 4) array
        Of (a, b, h_1, h_2); NaN without the polish.
    noise_sd : float
        Of white noise on y [y unit]; NaN without the polish.
    iterations : int
        Steps of the paper's iteration.
    """

    a: float
    b: float
    h1_s: float
    h2_s: float
    covariance: FloatArray
    noise_sd: float
    iterations: int

    @property
    def values(self) -> FloatArray:
        """(a, b, h_1, h_2)."""
        return np.array([self.a, self.b, self.h1_s, self.h2_s])

    @property
    def standard_deviations(self) -> FloatArray:
        """Of (a, b, h_1, h_2)."""
        return np.sqrt(np.diag(self.covariance))

    def to_json(self) -> dict[str, Any]:
        """Return the content of the file that ``autotune identify delay --delays 2`` writes."""
        sd = self.standard_deviations
        return {
            "equation": "x''(t) + a x(t - h1) = b u(t - h2)",
            "a": self.a,
            "b": self.b,
            "h1_s": self.h1_s,
            "h2_s": self.h2_s,
            "sd": dict(zip(("a", "b", "h1_s", "h2_s"), sd.tolist(), strict=True)),
            "covariance": self.covariance.tolist(),
            "noise_sd": self.noise_sd,
        }


def intervals_of(recording: Recording, length_s: float | None = None) -> list[Interval]:
    """Return overlapping intervals of one length over the later part of a record: the first part is the delays' past.

    Parameters
    ----------
    recording : Recording
        The record.
    length_s : float, optional
        Length of an interval [s], some times the delays; an eighth of the record when absent.
    """
    begin, end = float(recording.t[0]), float(recording.t[-1])
    length = (end - begin) / _LENGTHS if length_s is None else length_s
    least = _ROWS * (end - begin) / max(len(recording.t) - 1, 1)
    if not least <= length < 0.4 * (end - begin):
        raise InputError(
            f"intervals of {length:g} s in a record of {end - begin:.4g} s",
            where=recording.name,
            remedy=f"give a length of at least {least:.3g} s ({_ROWS} rows) and at most two fifths of the record",
        )
    count = int((end - begin - 2.5 * length) / length * _OVERLAP) + 1
    starts = np.linspace(begin + length, end - 1.5 * length, min(count, _MOST))
    return [(at, at + length) for at in starts.tolist()]


def two_delays(
    recording: Recording,
    intervals: Sequence[Interval],
    *,
    start_s: tuple[float, float] | None = None,
    iterations: int = 30,
    polish: bool = True,
) -> TwoDelays:
    """Estimate a, b and both delays by modulating functions over intervals of one length.

    Parameters
    ----------
    recording : Recording
        u and y, linear between rows, from the first interval's beginning less the delays on.
    intervals : sequence of (float, float)
        (T_1, T_2) [s], all of one length, at least four.
    start_s : (float, float), optional
        Starting values of h_1 and h_2 [s]; zeros and, where these come to no fixed point, a few others when absent.
    iterations : int
        Largest number of steps.
    polish : bool
        Whether more equations are weighted by their covariance from there, which also gives that of the estimate;
        without it the estimate is the paper's.

    Raises
    ------
    InputError
        Fewer than four intervals, or of unequal lengths.
    IdentificationError
        The iteration left the record, the gains vanish, or it has no fixed point.

    Notes
    -----
    For a periodic output the delays are defined up to its period. In the paper's estimate noise on y stands in the
    regressors: a and b are biased towards zero as it grows (Table 2). The polish presumes noise that is white from row
    to row.

    References
    ----------
    Example 3 and Table 2.
    """
    lengths = np.array([T_2 - T_1 for T_1, T_2 in intervals])
    if lengths.size < 4 or np.ptp(lengths) > 1e-9 * lengths.max():
        raise InputError(f"{lengths.size} intervals", where="intervals", remedy="give at least four, all of one length")
    recording.require_finite()
    L = float(lengths[0])
    starts = np.array([T_1 for T_1, _ in intervals])
    begun = [start_s] if start_s is not None else [(q * L, w * L) for q in _STARTS for w in _STARTS]
    found: list[tuple[float, TwoDelays]] = []
    refusal: IdentificationError | None = None
    for pair in begun:
        try:
            found.append(_iterate(recording, starts, L, pair, iterations))
        except IdentificationError as error:
            refusal = refusal or error
            continue
        if len(found) == 1 and (pair == (0.0, 0.0) or start_s is not None):
            break  # the paper's own start
    if not found:
        assert refusal is not None
        raise refusal
    best = min(found, key=lambda pair: pair[0])[1]
    return _polish(recording, starts, L, best) if polish else best


def _iterate(
    recording: Recording, starts: FloatArray, L: float, start: tuple[float, float], iterations: int
) -> tuple[float, TwoDelays]:
    """Return what the equations leave and the estimate at the fixed point that the paper's iteration comes to."""
    s = np.linspace(0.0, 1.0, max(64, round(L / recording.sample_time_s)) + 1)
    omega = 2.0 * np.pi / L
    weights = np.full(s.size, L / (s.size - 1))
    weights[[0, -1]] *= 0.5
    f = weights * (1.0 - np.cos(2.0 * np.pi * s))
    sine = weights * np.sin(2.0 * np.pi * s)
    # L^-2 I_{x,f''}, from rows that stay where they are
    target = omega**2 * _shift(recording, recording.y, starts, L * s, 0.0) @ (weights * np.cos(2.0 * np.pi * s))
    h1, h2 = start
    count = 0
    while count < iterations:
        count += 1
        x = _shift(recording, recording.y, starts, L * s, h1)
        u = _shift(recording, recording.u, starts, L * s, h2)
        matrix = np.column_stack([u @ f, u @ sine, -(x @ f), -(x @ sine)])
        solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
        b, b_sine, a, a_sine = solution
        if a == 0.0 or b == 0.0:
            raise IdentificationError("a gain vanishes", where=recording.name, remedy="the record excites too little")
        steps = np.arctan([a_sine / a, b_sine / b]) / omega  # the arctangent keeps a step below a quarter of L
        h1, h2 = h1 + float(steps[0]), h2 + float(steps[1])
        if np.max(np.abs(steps)) < 1e-7 * L:
            break
    if not (np.max(np.abs(steps)) < 1e-3 * L and min(h1, h2) > -_EARLY * L):
        raise IdentificationError(
            f"the iteration has no fixed point (last: delays {h1:.4g} and {h2:.4g} s)",
            where=recording.name,
            remedy="start nearer to the delays, or take other intervals",
        )
    left = float(np.linalg.norm(matrix @ solution - target))
    return left, TwoDelays(
        a=float(a), b=float(b), h1_s=h1, h2_s=h2, covariance=np.full((4, 4), np.nan), noise_sd=float("nan"),
        iterations=count,
    )  # fmt: skip


@on_one_thread
def _polish(recording: Recording, starts: FloatArray, L: float, start: TwoDelays) -> TwoDelays:
    """Return the minimum of the weighted equations, y being the output with white noise."""
    try:
        equations = _Equations.of(recording, Windows(starts, L, _HARMONICS), start.values)
        found = minimise_weighted(equations, start.values)
    except LinAlgError:
        found = None
    if found is None or not np.all(np.isfinite(found.covariance)) or found.condition > _DETERMINED:
        raise IdentificationError(
            "the record does not determine both delays", where=recording.name, remedy="excite more frequencies"
        )
    a, b, h1, h2 = (float(value) for value in found.values)
    return replace(
        start, a=a, b=b, h1_s=h1, h2_s=h2, covariance=found.covariance,
        noise_sd=float(np.sqrt(equations.rows_per_sample * found.variance)),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class _Equations:
    """Equations of (a, b, h_1, h_2): :class:`autotune.identification.delay.weighted_equations.Equations`."""

    windows: Windows
    t: FloatArray
    of_u: list[ComplexArray]
    of_y: list[ComplexArray]
    samples: FloatArray
    rows_per_sample: float

    @classmethod
    def of(cls, recording: Recording, windows: Windows, values: FloatArray) -> _Equations:
        width = max(windows.length_s / _SAMPLES, recording.sample_time_s)
        first = max(windows.starts[0] - 2.0 * max(float(values[2]), 0.0), recording.t[0])
        return cls(
            windows=windows,
            t=recording.t,
            of_u=windows.running(recording.t, recording.u, False),
            of_y=windows.running(recording.t, recording.y, False),
            samples=np.arange(first + 0.5 * width, windows.starts[-1] + windows.length_s, width),
            rows_per_sample=width / recording.sample_time_s,
        )

    def left(self, values: FloatArray) -> FloatArray:
        """Return x'' + a x(t - h_1) - b u(t - h_2) over every window."""
        a, b, h1, h2 = values.tolist()
        of = self.windows.of_signal
        x, late = of(self.t, self.of_y, 0.0, 2), of(self.t, self.of_y, h1, 0)
        return np.asarray(x + a * late - b * of(self.t, self.of_u, h2, 0), dtype=np.float64)

    def of_noise(self, values: FloatArray) -> FloatArray:
        """Return what samples of noise on y add."""
        on, width = self.windows.on, self.samples[1] - self.samples[0]
        return np.asarray(width * (on(self.samples, 0.0, 2) + values[0] * on(self.samples, float(values[2]), 0)))

    def steps(self, values: FloatArray) -> FloatArray:
        """Return the steps of difference quotients."""
        small = 1e-6 * self.windows.length_s
        return np.array([max(abs(values[0]), 1e-3), max(abs(values[1]), 1e-3), small, small])


def _shift(recording: Recording, values: FloatArray, starts: FloatArray, offsets: FloatArray, h: float) -> FloatArray:
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
