"""Discrete spectra of a recording: y, held u and r on the lines of one record length, stamps uniform or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, ComplexArray, FloatArray, smallest_step
from autotune.errors import IdentificationError
from autotune.identification.noise_colour import whitening_filter

#: Part of y that may be missing or wild before the record is refused.
_LARGEST_BAD_PART = 0.05
_OUTLIER_SD = 8.0
#: Part of the slope beside a sample by which a curve may miss it. Any part below 1 tells a pair of spikes from a turn:
#: the first would have to be both less than the second and more.
_TURN = 0.8


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectra:
    """Fourier sums over one record, per second of record.

    Attributes
    ----------
    omega_rad_s : (K,) array
        Lines 2 pi k / T, k = 1 .. K [rad/s].
    E : (K,) complex array
        Of y, or of y less a rough model's response.
    U : (K,) complex array
        Of the held command, exact where the stamps are uniform.
    R : (K,) complex array or None
        Of the set-point.
    weight : (K,) array
        Of each line in a least-squares fit: what is in E, with it, is about as large on all lines.
    common : float
        Power on each line of E that rounding can have in common with the command, see :func:`common_rounding`.
    """

    omega_rad_s: FloatArray
    E: ComplexArray
    U: ComplexArray
    R: ComplexArray | None
    weight: FloatArray
    common: float = 0.0


def common_rounding(y: FloatArray) -> float:
    """Return the variance of readings' rounding that goes with what they measure [unit of y, squared].

    Parameters
    ----------
    y : (N,) array
        Measurement, NaN where a sample was bad.

    Notes
    -----
    What repeats is rounded alike each time: it is no noise, and no residual shows it. Noise of sd s before rounding to
    multiples of q leaves exp(-(2 pi s / q)^2) of its power, for that is the square of the first harmonic of a saw tooth
    averaged over the noise; s is what changes from row to row beyond a straight line, less rounding's own share. Bias:
    y that bends within three rows counts as noise; it goes through many steps then, so that little is common. As a
    power it is spread over all lines: of a y of three or four values that repeats, few lines carry most of it.

    References
    ----------
    Widrow and Kollar, Quantization Noise, Cambridge 2008, chapter 19 (dither).
    """
    y = y[np.isfinite(y)]
    step = smallest_step(y)
    if y.size < 3 or step == 0.0:
        return 0.0
    rounding = step**2 / 12.0
    noise = max(float(np.mean(np.diff(y, 2) ** 2)) / 6.0 - rounding, 0.0)
    return rounding * float(np.exp(-noise * (2.0 * np.pi / step) ** 2))


def clean_measurement(t: FloatArray, y: FloatArray, name: str) -> tuple[FloatArray, int]:
    """Return y with missing and wild samples replaced by interpolation, and their number.

    Parameters
    ----------
    t, y : (N,) array
        Stamps [s] and measurement, NaN where a sample was bad.
    name : str
        Where it came from, for the message.

    Raises
    ------
    IdentificationError
        More than 5 % of the samples are missing or wild.

    Notes
    -----
    Wild is a sample that lies eight robust standard deviations outside what the middle two of its four nearest
    neighbours span, and not where the neighbours lead to: both sides to a peak, either to what lies between them. One
    spike or two in a row do; the corner at which a fast plant begins to answer a step, and the peak at which its
    command turns it round, do not, however little noise there is.
    """
    good = np.isfinite(y)
    filled = np.interp(t, t[good], y[good]) if good.sum() > 8 else y
    good = good & ~_wild(filled)
    bad = int(y.size - good.sum())
    if bad > _LARGEST_BAD_PART * y.size:
        raise IdentificationError(
            f"{bad} of {y.size} samples of y are missing or wild",
            where=name,
            remedy="repair the sensor or its wiring and record again",
        )
    return (np.interp(t, t[good], y[good]) if bad else y), bad


def _wild(y: FloatArray) -> BoolArray:
    """Return which samples of (N,) are spikes."""
    wild = np.zeros(y.size, dtype=bool)
    if y.size <= 8:
        return wild
    _, low, high, _ = np.sort(np.stack([y[:-4], y[1:-3], y[3:-1], y[4:]]), axis=0)
    inner = y[2:-2]
    scale = 1.4826 * float(np.median(np.abs(inner - 0.5 * (low + high))))
    outside = np.maximum(low - inner, inner - high)
    slopes = np.stack([y[1:-3] - y[:-4], y[3:-1] - y[4:]])  # of either side, towards the sample
    off = np.abs(inner - np.stack([y[1:-3], y[3:-1]]) - slopes)
    led_to = off <= np.maximum(_OUTLIER_SD * scale, _TURN * np.abs(slopes))
    between = (inner - y[1:-3]) * (y[3:-1] - inner) > 0.0
    steep = np.max(np.abs(slopes), axis=0)
    turns = np.max(off, axis=0) <= np.maximum(_OUTLIER_SD * scale, _TURN * steep)
    turns |= between & np.any(led_to, axis=0)
    wild[2:-2] = (outside > _OUTLIER_SD * scale) & (scale > 0.0) & ~turns
    return wild


def record_spectra(
    t: FloatArray, u: FloatArray, e: FloatArray, r: FloatArray | None, *, highest_rad_s: float, common: float = 0.0
) -> Spectra:
    """Transform one record.

    Parameters
    ----------
    t, u, e : (N,) array
        Stamps [s], held command, and measurement (or what a rough model leaves of it).
    r : (N,) array, optional
        Set-point.
    highest_rad_s : float
        Lines above are not returned.
    common : float
        Variance of e that goes with the command, as :func:`common_rounding` returns it.

    Notes
    -----
    Stamps that are not uniform are brought to the mean step: u by its mean over each step, which is exact but for
    images, e by linear interpolation. Time is proportional to N log N.
    """
    n = t.size
    step = float(t[-1] - t[0]) / (n - 1)
    uniform = bool(np.all(np.abs(np.diff(t) - step) < 1e-3 * step))
    grid = t[0] + step * np.arange(n)
    k = np.arange(1, max(2, min(n // 2, int(highest_rad_s * n * step / (2.0 * np.pi)) + 1)))
    omega: FloatArray = np.asarray(2.0 * np.pi * k / (n * step), dtype=np.float64)
    if uniform:
        levels, within = u - u.mean(), (1.0 - np.exp(-1j * omega * step)) / (1j * omega * step)
    else:
        area = np.concatenate([[0.0], np.cumsum((u[:-1] - u.mean()) * np.diff(t))])
        edges = np.append(grid, grid[-1] + step)
        at_edges = np.interp(edges, t, area)
        at_edges[-1] = area[-1] + (u[-1] - u.mean()) * step
        levels = np.diff(at_edges) / step
        # the mean over a step is the convolution with it: take its transform off again
        within = np.exp(-0.5j * omega * step) / np.sinc(omega * step / (2.0 * np.pi))
        e = np.interp(grid, t, e)
        r = np.interp(grid, t, r) if r is not None else None
    e = e - e.mean()
    return Spectra(
        omega_rad_s=omega,
        E=np.fft.rfft(e)[k] / n,
        U=np.fft.rfft(levels)[k] / n * within,
        R=np.fft.rfft(r - r.mean())[k] / n if r is not None else None,
        weight=_whitening(e, omega * step),
        common=common / n,
    )


def _whitening(e: FloatArray, omega: FloatArray) -> FloatArray:
    """Return the gain of the filter that makes e white at some frequencies [rad/row]; 1 where e is zero."""
    colour = whitening_filter(e) if np.any(e) else np.empty(0)
    delays = np.exp(-1j * np.outer(omega, np.arange(1, colour.size + 1)))
    return np.asarray(np.abs(1.0 + delays @ colour))
