"""Which part of long recordings a search works on, and what stands out of a residual."""

from __future__ import annotations

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.equations.fit_data import Fitted

#: Lines of a residual at which a periodic load is tried.
LINES = 3


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


def standing_out(residual: FloatArray, dt_s: float) -> tuple[float, ...]:
    """Return the frequencies at which a residual has most [Hz]."""
    e = np.nan_to_num(residual - np.nanmean(residual)) * np.hanning(residual.size)
    power = np.abs(np.fft.rfft(e))
    power[:3] = 0.0
    return tuple(float(np.fft.rfftfreq(e.size, dt_s)[k]) for k in np.argsort(-power)[:LINES])
