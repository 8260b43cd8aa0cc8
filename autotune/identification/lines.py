"""Commands that are a few sines, as a test of the frequency response sends, and how surely y answers them.

Their past foretells such commands, so that no row of them is news and timing does not tell which column follows which.
What tells is what lines leave: an effect carries what its cause does beside them. And a line of y at the frequency of
one of u stands above the noise around it, or does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import ComplexArray, FloatArray

#: more sines, or sines of fewer periods in the record, are looked at as any other command
_MOST_LINES, _LEAST_PERIODS = 8, 4.0
#: a command is lines where they leave less than this part of its spread: a converter's steps, and hardly a corner
_LEFT = 0.05
#: of eight lines that are all of a signal the largest has an eighth of its variance; half of that where two are near
_LEAST_HELD = 1.0 / 16.0
#: where no more than this is left of it, there is no other line: two that are near each other are taken for one first
_NOTHING = 1e-6
#: lines nearer to each other than this part of a period in the record are none that it tells apart
_APART = 0.5
#: bins of the spectrum on either side of a line that say how large noise is there, but for the nearest ones
_AROUND, _NEAREST = 10, 2
_STEPS = 6


def find_lines(x: FloatArray) -> FloatArray:
    """Return the frequencies of the sines that a signal is; none where it is something else.

    Parameters
    ----------
    x : (N,) array
        Readings in every row.

    Returns
    -------
    (M,) array
        Cycles per row, eight at most.
    """
    spread, frequencies = float(np.std(x)), np.zeros(0)
    window = np.hanning(x.size)
    left = x - x.mean()
    while frequencies.size < _MOST_LINES and float(np.std(left)) > _NOTHING * spread:
        spectrum = np.abs(np.fft.rfft(left * window, 4 * x.size))
        peak = int(np.argmax(spectrum))
        held = 2.0 * (float(spectrum[peak]) / float(np.sum(window))) ** 2  # variance of a sine of that height
        if peak < 4.0 * _LEAST_PERIODS or held < _LEAST_HELD * float(np.var(left)):
            break
        more = _refined(x, np.append(frequencies, peak / (4.0 * x.size)))
        if np.any(np.diff(np.sort(more)) * x.size < _APART):
            break
        frequencies, left = more, without_lines(x, more)
    return frequencies if float(np.std(left)) <= _LEFT * spread else np.zeros(0)


def is_one_sine(x: FloatArray) -> bool:
    """Return whether a signal is a single sine, but for what a converter makes of it.

    Parameters
    ----------
    x : (N,) array
        Readings in every row.
    """
    lines = find_lines(x)
    return bool(lines.size) and float(np.std(without_lines(x, lines[:1]))) <= _LEFT * float(np.std(x))


def without_lines(x: FloatArray, frequencies: FloatArray) -> FloatArray:
    """Return what sines of some frequencies, a level and a slope leave of a signal.

    Parameters
    ----------
    x : (N,) array
        Readings in every row.
    frequencies : (M,) array
        Cycles per row.
    """
    columns = _columns(x.size, frequencies)
    return np.asarray(x - columns @ np.linalg.lstsq(columns, x, rcond=None)[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedLines:
    """Sines in a signal beside a level, a slope and noise.

    Attributes
    ----------
    values : (M,) complex array
        Of each line exp(j omega t) from the first row on, in the signal's unit.
    covariances : (M, 2, 2) array
        Of their real and imaginary parts; NaN where no bin tells of the noise.
    sums : (M,) array
        Half the square of each value over the variance that noise gives it.
    bins : (M,) array
        Bins of the spectrum around each that tell of the noise.
    """

    values: ComplexArray
    covariances: FloatArray
    sums: FloatArray
    bins: FloatArray


def fit_lines(x: FloatArray, frequencies: FloatArray) -> FittedLines:
    """Return the lines of a signal at known frequencies, and how well noise lets them be known.

    Parameters
    ----------
    x : (N,) array
        Readings in every row.
    frequencies : (M,) array
        Cycles per row, at least one.

    Notes
    -----
    The level of the noise at each line is that of the bins around it, other lines left out: it may have any smooth
    spectrum.
    """
    columns = _columns(x.size, frequencies)
    solved = np.linalg.lstsq(columns, x, rcond=None)[0]
    noise = np.abs(np.fft.rfft(x - columns @ solved)) ** 2 / x.size
    covariance = np.linalg.pinv(columns.T @ columns)  # of what is solved for, in units of the noise's variance
    bins, at = np.arange(noise.size), frequencies * x.size
    far = (np.min(np.abs(bins[:, None] - at), axis=1) >= _NEAREST) & (bins > 0)
    values, covariances, sums, counts = [], [], [], []
    for number, line in enumerate(at):
        around = noise[far & (np.abs(bins - line) <= _AROUND)]
        its = slice(2 + 2 * number, 4 + 2 * number)
        each, (a, b) = covariance[its, its], solved[its]
        level = float(np.mean(around)) if around.size else math.nan
        values.append(complex(a, -b))
        covariances.append(level * each * np.array([[1.0, -1.0], [-1.0, 1.0]]))
        sums.append(0.5 * float(solved[its] @ np.linalg.pinv(each) @ solved[its]) / max(level, 1e-300))
        counts.append(around.size)
    return FittedLines(
        values=np.array(values), covariances=np.array(covariances), sums=np.array(sums), bins=np.array(counts, float)
    )


def chance_of_lines(y: FloatArray, frequencies: FloatArray) -> float:
    """Return how likely noise alone has as large a line at one of some frequencies.

    Parameters
    ----------
    y : (N,) array
        Readings in every row, whitened.
    frequencies : (M,) array
        Cycles per row, at least one.

    Notes
    -----
    The harmonic F test; Bonferroni over lines.

    References
    ----------
    Thomson, Spectrum estimation and harmonic analysis, Proc. IEEE 70, 1982, section XIII.
    """
    fitted = fit_lines(y, frequencies)
    chances = (1.0 + fitted.sums / np.maximum(fitted.bins, 1.0)) ** -fitted.bins
    return float(min(1.0, np.min(chances) * frequencies.size))


def _columns(rows: int, frequencies: FloatArray) -> FloatArray:
    k = np.arange(rows)
    turns = 2.0 * np.pi * np.outer(k, frequencies)
    waves = np.stack([np.cos(turns), np.sin(turns)], axis=2).reshape(rows, -1)
    return np.column_stack([np.ones(rows), k / rows - 0.5, waves])


def _refined(x: FloatArray, frequencies: FloatArray) -> FloatArray:
    """Return the frequencies at which sines leave least, from near them: Gauss-Newton."""
    k = 2.0 * np.pi * np.arange(x.size)
    for _ in range(_STEPS):
        columns = _columns(x.size, frequencies)
        values = np.linalg.lstsq(columns, x, rcond=None)[0]
        cosines, sines = values[2::2], values[3::2]
        turned = k[:, None] * (columns[:, 2::2] * sines - columns[:, 3::2] * cosines)
        steps = np.linalg.lstsq(np.column_stack([columns, turned]), x - columns @ values, rcond=None)[0]
        most = 0.25 / x.size
        frequencies = frequencies + np.clip(steps[columns.shape[1] :], -most, most)
    return frequencies
