"""Which part of long recordings a search works on, and how far a position goes beyond a stop."""

from __future__ import annotations

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.equations.fit_data import Fitted
from autotune.models import Effect


def telling_windows(fitted: Fitted, rows: int) -> list[BoolArray]:
    """Return which windows of each recording to search on: a run of them that a fit leaves most in.

    As many of every recording as hold its share of some rows. One follows the other, so that where one ends tells where
    the next begins.
    """
    share = rows / sum(int(np.sum(w.stops - w.starts)) for w in fitted.windows)
    kept = []
    for w, e in zip(fitted.windows, fitted.residuals, strict=True):
        squares = [float(np.nansum(e[a:b] ** 2)) for a, b in zip(w.starts, w.stops, strict=True)]
        count = min(max(round(share * w.starts.size), 1), w.starts.size)
        first = int(np.argmax(np.convolve(squares, np.ones(count), "valid")))
        kept.append((np.arange(w.starts.size) >= first) & (np.arange(w.starts.size) < first + count))
    return kept


def beyond(x: FloatArray, stop: Effect) -> float:
    """Return how far a position goes beyond a stop, as a share of what it moves through."""
    high = stop.parameters["high"].value if "high" in stop.parameters else np.inf
    low = stop.parameters["low"].value if "low" in stop.parameters else -np.inf
    return float(max(np.max(x) - high, low - np.min(x), 0.0) / max(float(np.ptp(x)), 1e-300))
