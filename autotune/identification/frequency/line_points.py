"""Frequency points from a command of a few sines: what y has of each, beside the noise around it."""

from __future__ import annotations

import math

import numpy as np

from autotune.arrays import FloatArray
from autotune.identification.lines import find_lines, fit_lines
from autotune.points import FrequencyPoint, as_pairs

#: part of the record that y gets to come to rest from how it began
_SETTLING = 0.25


def line_points(t: FloatArray, u: FloatArray, y: FloatArray, *, held: bool) -> list[FrequencyPoint]:
    """Return a point at every sine of u; none where u is something else.

    Parameters
    ----------
    t, u, y : (N,) array
        Time [s], evenly spaced, command and readings.
    held : bool
        Whether u holds until the next row; else it runs straight.

    Notes
    -----
    Sines, a level and a slope are fitted to what follows the first quarter of the record; the noise is what they leave
    at the frequencies around. What the plant still does of its start by then is taken for noise and may bias a point.

    References
    ----------
    Ljung, System Identification, 2nd ed. 1999, section 6.2: frequency analysis by the correlation method.
    """
    lines = find_lines(u)
    if not lines.size:
        return []
    first, dt = int(_SETTLING * t.size), float(t[-1] - t[0]) / (t.size - 1)
    of_u, of_y = fit_lines(u[first:], lines), fit_lines(y[first:], lines)
    omega = 2.0 * math.pi * lines / dt
    half = 0.5 * omega * dt
    hold = np.sinc(half / math.pi) * np.exp(-1j * half) if held else np.sinc(half / math.pi) ** 2
    points = []
    largest = float(np.max(np.abs(of_u.values)))
    for i in np.argsort(omega):
        base = of_u.values[i] * hold[i]
        if abs(of_u.values[i]) < 0.02 * largest:
            continue
        turn = np.array([[base.real, base.imag], [-base.imag, base.real]]) / abs(base) ** 2
        points.append(
            FrequencyPoint(
                omega_rad_s=float(omega[i]),
                response=complex(of_y.values[i] / base),
                covariance=as_pairs(turn @ of_y.covariances[i] @ turn.T),
                source="spectral",
            )
        )
    return points
