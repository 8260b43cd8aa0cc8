"""Frequency points of a relay limit cycle: whole-period Fourier ratio of recorded y over recorded, held u.

The phase comes from the recorded signals alone: hysteresis, hold, transport and latency are in both and drop out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, ComplexArray, FloatArray
from autotune.errors import IdentificationError
from autotune.identification.frequency.harmonics import HarmonicFit, fit_harmonics, held_coefficients
from autotune.identification.frequency.limit_cycle import RelayEdges, WholePeriods, relay_edges, whole_periods
from autotune.identification.frequency.reference_model import (
    ReferenceModel,
    fit_reference,
    free_responses,
    simulate_reference,
)
from autotune.identification.noise_colour import noise_colour, region_widening
from autotune.points import FrequencyPoint, as_pairs

_HIGHEST_HARMONIC = 9
_OUTLIER_SD = 6.0


@dataclass(frozen=True, kw_only=True)
class LimitCycle:
    """What one settled relay limit cycle says.

    Attributes
    ----------
    points : tuple of FrequencyPoint
        The fundamental first, then the odd harmonics that stand above the noise.
    period_s : float
        Mean period [s].
    periods : int
        Whole periods used.
    start_s, end_s : float
        Window used [s].
    u_mean : float
        Mean command over the window: holds an integrating plant where it is, the drift apart [u unit].
    u_amplitude : float
        Half of the relay's peak-to-peak command [u unit].
    y_amplitude : float
        Amplitude of the fundamental of y [y unit].
    y_peak_to_peak : float
        Mean over the periods of highest less lowest sample, noise included: what is read off a plot [y unit].
    asymmetry : float
        Part of the period the command is high, less one half.
    drift : float
        Drift of y that the held command does not explain [y unit/s].
    noise_sd : float
        Standard deviation of the residual noise of y [y unit].
    outliers : int
        Samples left out: more than six standard deviations off, or not a number.
    """

    points: tuple[FrequencyPoint, ...]
    period_s: float
    periods: int
    start_s: float
    end_s: float
    u_mean: float
    u_amplitude: float
    y_amplitude: float
    y_peak_to_peak: float
    asymmetry: float
    drift: float
    noise_sd: float
    outliers: int


def limit_cycle_points(
    t: FloatArray,
    u: FloatArray,
    y: FloatArray,
    *,
    highest_harmonic: int = _HIGHEST_HARMONIC,
    largest_relative_sd: float = 0.1,
    window: WholePeriods | None = None,
    known: Sequence[FrequencyPoint] = (),
) -> LimitCycle:
    """Estimate the plant's complex gain at the fundamental and the odd harmonics of a settled relay limit cycle.

    Parameters
    ----------
    t : (N,) array
        Recorded stamps [s], strictly increasing, not necessarily uniform.
    u : (N,) array
        Command held from each stamp to the next.
    y : (N,) array
        Measurement at each stamp, before that row's command acts; NaN where a sample was bad.
    highest_harmonic : int
        Highest odd harmonic tried; only those below 0.8 of the Nyquist frequency are.
    largest_relative_sd : float
        A harmonic is given when its standard deviation is below this part of its gain.
    window : WholePeriods, optional
        Window to use, beginning anywhere in the cycle; by default the longest one from switch to switch.
    known : sequence of FrequencyPoint
        Points of other cycles of the same plant: they make the rough model better, and enter the estimate no further.

    Returns
    -------
    LimitCycle
        Points with covariance, and the summary of the cycle.

    Raises
    ------
    IdentificationError
        No relay, fewer than two whole periods, too few samples per period, or no response above the noise.

    Notes
    -----
    Regressing the harmonics, an offset and a drift on y is the maximum-likelihood estimate for white noise and a
    strictly periodic command. Switching that jitters makes the command not quite periodic; a rough model fitted to
    the first estimate carries that part, so that the ratio is taken on its error only (``reference_model``).
    In a relay loop the noise also moves the switches; the remaining bias is of the order of the noise variance over the
    oscillation's, per sample in a switch, and is measured in ``tests/benchmarks/frequency_points.py``.
    """
    edges = relay_edges(t, u)
    window = window or whole_periods(edges, float(t[-1]) + float(t[-1] - t[-2]))
    slack = 1e-6 * window.period_s  # a stamp and a switch at one instant differ by rounding
    inside = (t >= window.start_s - slack) & (t < window.end_s - slack)
    good = inside & np.isfinite(y)
    orders = _orders(window, good, highest_harmonic)
    fit, reference, outliers = _corrected_fit(t, u, y, good, window, orders, known)
    omega = window.omega_rad_s * np.array(orders)
    U = held_coefficients(t, u, omega, window.start_s, window.end_s)
    # of few periods the harmonics take most of the noise at low frequencies; stamps that jitter count as uniform, which
    # is right for frequencies as far below the sampling rate as a limit cycle's
    sample_time_s = window.period_s * window.periods / int(inside.sum())
    points = _points(omega, orders, U, fit, sample_time_s, reference, largest_relative_sd)
    return _summary(t, u, y, good, window, edges, points, fit, outliers + int((inside & ~good).sum()))


def _orders(window: WholePeriods, good: BoolArray, highest: int) -> tuple[int, ...]:
    """Return the harmonics to fit: all orders (an asymmetric cycle has even ones) well below the Nyquist frequency."""
    per_period = int(good.sum()) / window.periods
    if per_period < 8:
        raise IdentificationError(
            f"{per_period:.1f} samples per period of {window.period_s:g} s are too few",
            where="limit cycle",
            remedy="sample faster, or add delay to the relay so that it oscillates more slowly",
        )
    return tuple(range(1, max(3, min(highest, int(0.4 * per_period))) + 1))


def _corrected_fit(
    t: FloatArray,
    u: FloatArray,
    y: FloatArray,
    good: BoolArray,
    window: WholePeriods,
    orders: Sequence[int],
    known: Sequence[FrequencyPoint],
) -> tuple[HarmonicFit, ReferenceModel | None, int]:
    """Fit the harmonics of y, then twice those of y less the rough model's response; leave outliers out."""
    omega = window.omega_rad_s * np.array(orders)
    U = held_coefficients(t, u, omega, window.start_s, window.end_s)
    U[np.abs(U) < 1e-12 * np.abs(U[0])] = 1e-12 * np.abs(U[0])  # the even orders of a symmetric cycle may be exactly 0
    centred = u - np.mean(u[good])
    excited = np.abs(U) > 0.05 * np.abs(U[0])
    fit = fit_harmonics(t[good], y[good], window.omega_rad_s, orders)
    G = fit.coefficients / U
    reference: ReferenceModel | None = None
    outliers = 0
    for _ in range(2):
        sd = np.std(fit.residual) * np.sqrt(np.trace(fit.covariance_unit, axis1=1, axis2=2)) / np.abs(U)
        trial = fit_reference(
            np.concatenate([omega[excited], [point.omega_rad_s for point in known]]),
            np.concatenate([G[excited], [point.response for point in known]]),
            np.concatenate([sd[excited], [math.sqrt(0.5 * float(np.trace(point.covariance))) for point in known]]),
            np.concatenate([np.abs(U[excited]), np.full(len(known), np.abs(U[0]))]),
        )
        remainder = y - simulate_reference(t, centred, trial)
        transients = free_responses(t[good], trial)
        trial_fit = fit_harmonics(t[good], remainder[good], window.omega_rad_s, orders, transients=transients)
        wild = _wild(trial_fit.residual, float(np.std(y[good])))
        if wild.any():
            good = good.copy()
            good[np.flatnonzero(good)[wild]] = False
            outliers += int(wild.sum())
            transients = free_responses(t[good], trial)
            trial_fit = fit_harmonics(t[good], remainder[good], window.omega_rad_s, orders, transients=transients)
        fit, reference = trial_fit, trial
        G = reference.response(omega) + fit.coefficients / U
    return fit, reference, outliers


def _wild(residual: FloatArray, signal_sd: float) -> BoolArray:
    """Return which samples are too far off to be noise; none where what is left is no noise but rounding."""
    wild = np.abs(residual) > max(_OUTLIER_SD * 1.4826 * float(np.median(np.abs(residual))), 0.05 * signal_sd)
    return wild if wild.sum() < 0.05 * wild.size else np.zeros_like(wild)


def _points(
    omega: FloatArray,
    orders: Sequence[int],
    U: ComplexArray,
    fit: HarmonicFit,
    sample_time_s: float,
    reference: ReferenceModel | None,
    largest_relative_sd: float,
) -> tuple[FrequencyPoint, ...]:
    """Return the odd harmonics' complex gains with the covariance that the noise at each of them makes."""
    base = reference.response(omega) if reference is not None else np.zeros_like(U)
    noise = noise_colour(fit.columns, fit.residual)
    variance = noise.variance_at(omega * sample_time_s)
    points = []
    for i, order in enumerate(orders):
        if order % 2 == 0 or abs(U[i]) < 1e-3 * abs(U[0]):
            continue
        response = complex(base[i] + fit.coefficients[i] / U[i])
        inverse = 1.0 / U[i]
        turn = np.array([[inverse.real, -inverse.imag], [inverse.imag, inverse.real]])
        widening = region_widening(min(noise.freedom[i], noise.freedom[i + len(orders)]))
        covariance = widening * variance[i] * turn @ fit.covariance_unit[i] @ turn.T
        sd = float(np.sqrt(np.trace(covariance) / 2.0))
        if order > 1 and sd > largest_relative_sd * abs(response):
            continue
        if order == 1 and sd > 0.5 * abs(response):
            raise IdentificationError(
                f"the oscillation of y at {omega[0]:.4g} rad/s is drowned in noise of sd {fit.noise_sd:.3g}",
                where="limit cycle",
                remedy="raise the relay's amplitude or record more periods",
            )
        points.append(
            FrequencyPoint(
                omega_rad_s=float(omega[i]),
                response=response,
                covariance=as_pairs(covariance),
                source="relay" if order == 1 else "harmonic",
            )
        )
    return tuple(points)


def _peak_to_peak(t: FloatArray, y: FloatArray, window: WholePeriods) -> float:
    which = np.clip(((t - window.start_s) / window.period_s + 1e-9).astype(int), 0, window.periods - 1)
    starts = np.unique(np.searchsorted(which, np.arange(window.periods)))
    return float(np.mean(np.maximum.reduceat(y, starts) - np.minimum.reduceat(y, starts)))


def _summary(
    t: FloatArray,
    u: FloatArray,
    y: FloatArray,
    good: BoolArray,
    window: WholePeriods,
    edges: RelayEdges,
    points: tuple[FrequencyPoint, ...],
    fit: HarmonicFit,
    outliers: int,
) -> LimitCycle:
    orders = range(1, len(fit.coefficients) + 1)
    plain = fit_harmonics(t[good], y[good], window.omega_rad_s, orders)
    knots = np.concatenate([[window.start_s], t[(t > window.start_s) & (t < window.end_s)], [window.end_s]])
    levels = u[np.clip(np.searchsorted(t, knots[:-1], side="right") - 1, 0, None)]
    above = levels > 0.5 * (levels.min() + levels.max())
    high = np.sum(np.diff(knots)[above]) / (window.end_s - window.start_s)
    return LimitCycle(
        points=points,
        period_s=window.period_s,
        periods=window.periods,
        start_s=window.start_s,
        end_s=window.end_s,
        u_mean=float(np.sum(levels * np.diff(knots)) / (window.end_s - window.start_s)),
        u_amplitude=0.5 * edges.jump,
        y_amplitude=float(2.0 * abs(plain.coefficients[0])),
        y_peak_to_peak=_peak_to_peak(t[good], y[good], window),
        asymmetry=float(high - 0.5),
        drift=fit.slope,
        noise_sd=fit.noise_sd,
        outliers=outliers,
    )
