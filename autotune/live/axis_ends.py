"""Where the axes of the live page end: at round numbers, so that the labels at their ends can be read at once.

A damaged file may hold any number: what is not finite is not shown, and ends that would not be are left to the chart.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from autotune.arrays import FloatArray

#: Intervals of an axis, at least.
_INTERVALS = 4


def linear_ends(low: float, high: float) -> dict[str, Any]:
    """Return ends and interval of an axis that shows a range, all multiples of 1, 2 or 5 times a power of ten.

    Parameters
    ----------
    low, high : float
        What is shown at least; a range of nothing gets one interval on either side.
    """
    width = high - low or abs(high) or 1.0
    if not 0.0 < 1.0 / width < math.inf:
        return {}
    step = 1.0 / _ceil_125(_INTERVALS / width)  # the largest that is round
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return {"min": _digits(first * step), "max": _digits(max(last, first + 1) * step), "interval": _digits(step)}


def log_ends(values: FloatArray) -> dict[str, Any]:
    """Return the ends of a logarithmic axis a little beyond the values: 1, 2 or 5 times a power of ten.

    Parameters
    ----------
    values : (N,) array
        Positive; .1 to 10 where there are none.
    """
    values = values[(values > 1e-300) & (values < 1e300)]
    if not values.size:
        return {"min": 0.1, "max": 10.0}
    return {"min": 1.0 / _ceil_125(1.2 / float(values.min())), "max": _ceil_125(1.2 * float(values.max()))}


def phase_ends(phase_deg: FloatArray) -> dict[str, Any]:
    """Return the ends and the ticks of an axis of phases: multiples of 15 or 45 degrees.

    Parameters
    ----------
    phase_deg : (N,) array
        Phases [deg]; a usual range where there are none.
    """
    phase_deg = phase_deg[np.isfinite(phase_deg)]
    low, high = (float(phase_deg.min()), float(phase_deg.max())) if phase_deg.size else (-180.0, -90.0)
    tick = 15 if high - low < 60.0 else 45
    return {
        "min": tick * math.floor((low - 4.0) / tick),
        "max": tick * math.ceil((high + 4.0) / tick),
        "interval": tick,
    }


def _ceil_125(value: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is no less than a positive value."""
    decade = 10.0 ** math.floor(math.log10(value))
    return _digits(next((m * decade for m in (1.0, 2.0, 5.0) if m * decade >= value * (1.0 - 1e-12)), 10.0 * decade))


def _digits(value: float) -> float:
    """Return the number without what its last binary digits add in decimals."""
    return float(f"{value:.9g}")
