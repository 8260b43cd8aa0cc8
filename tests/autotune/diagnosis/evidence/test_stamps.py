"""Stamps that are late, and stamps that are only uneven."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.diagnosis.evidence.stamps import even_stamps
from autotune.diagnosis.thresholds import IN_USE
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording


def decay(t):
    return np.exp(-0.3 * t) * np.cos(29.0 * t)


def bursts(n: int, dt: float) -> np.ndarray:
    """Times at which rows arrive that a line delivers eight at a time."""
    last = dt * (np.arange(n) // 8 * 8 + 8)
    return last + 1e-4 * (np.arange(n) % 8)


ARM = Model(
    name="arm",
    input=Port(),
    output=Port(unit="deg"),
    blocks=(Block(name="arm", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.6, 841.0))),),
)


def test_rows_that_were_taken_evenly_and_stamped_on_arrival_are_simulated_at_even_times():
    n, dt = 1200, 0.004
    arrived = bursts(n, dt)
    recording = Recording(t=arrived, u=np.zeros(n), y=decay(dt * np.arange(n)))
    changed, jitter = even_stamps(ARM, [recording], IN_USE)
    assert jitter is not None
    assert jitter.name == "timing.jitter"
    assert np.ptp(np.diff(changed[0].t)) < 1e-9


def test_even_times_are_those_that_stamps_are_late_of_whatever_the_first_and_the_last_are():
    n, dt = 1400, 0.004
    late = np.random.default_rng(3).exponential(0.02, n)
    late[[0, -1]] = 0.0, 0.1
    stamps = np.maximum.accumulate(dt * np.arange(n) + late) + 1e-7 * np.arange(n)
    even = Recording(t=stamps, u=np.zeros(n), y=np.zeros(n)).at_even_times()
    assert np.diff(even.t) == pytest.approx(dt, rel=1e-3)
    assert np.all(even.t <= stamps + 1e-9)
    exact = Recording(t=dt * np.arange(n), u=np.zeros(n), y=np.zeros(n)).at_even_times()
    assert exact.t == pytest.approx(dt * np.arange(n), abs=1e-9)


def test_rows_that_were_taken_when_their_stamps_say_keep_them():
    n, dt = 1200, 0.004
    taken = bursts(n, dt)
    recording = Recording(t=taken, u=np.zeros(n), y=decay(taken))
    changed, jitter = even_stamps(ARM, [recording], IN_USE)
    assert jitter is None
    assert changed[0] is recording


def test_even_stamps_are_not_looked_at():
    recording = Recording(t=0.004 * np.arange(200), u=np.zeros(200), y=np.zeros(200))
    changed, jitter = even_stamps(ARM, [recording], IN_USE)
    assert jitter is None
    assert changed[0] is recording
