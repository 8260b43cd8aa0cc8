"""Recordings of simulated plants for campaigns: first order with dead time under random binary steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from autotune.arrays import FloatArray

GAIN, TAU_S, DEAD_TIME_S, SAMPLE_S = 2.0, 2.0, 0.5, 0.1


def signals(seed: int, rows: int = 2000, gain: float = GAIN) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return t, u and y of gain exp(-L s)/(tau s + 1) about u = 50, y = 20, with noise of 0.01."""
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.choice([-0.5, 0.5], rows), rng.integers(3, 40, rows))[:rows]
    steps[:20] = 0.0  # at rest before: nothing of the past is still on its way through the dead time
    decay = np.exp(-SAMPLE_S / TAU_S)
    late = round(DEAD_TIME_S / SAMPLE_S)
    delayed = np.concatenate([np.zeros(late), steps])[:rows]
    y = lfilter([0.0, gain * (1.0 - decay)], [1.0, -decay], delayed)
    return SAMPLE_S * np.arange(rows), 50.0 + steps, 20.0 + y + rng.normal(0.0, 0.01, rows)


def write(path: Path, columns: dict[str, FloatArray]) -> Path:
    """Write columns as a CSV recording."""
    np.savetxt(
        path, np.column_stack(list(columns.values())), fmt="%.9g", delimiter=",", header=",".join(columns), comments=""
    )
    return path


def plant_file(path: Path, seed: int, rows: int = 2000, gain: float = GAIN) -> Path:
    """Write one recording."""
    return write(path, dict(zip("tuy", signals(seed, rows, gain), strict=True)))
