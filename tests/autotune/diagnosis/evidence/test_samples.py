"""What the samples alone show: converter steps, frozen readings, spikes; and the noise's own numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.diagnosis.evidence.readings import converter_step, frozen_rows, spikes
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.noise import autoregressive_up_to, noise_from_differences
from autotune.recording import Recording


def rounded(values: np.ndarray) -> np.ndarray:
    return np.array([float(f"{v:.6g}") for v in values])


def signal(seed: int, rows: int = 3000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return 5.0 + np.sin(np.arange(rows) * 0.01) + 0.03 * rng.normal(size=rows)


@settings(max_examples=10)
@given(step=st.floats(0.02, 0.2), seed=st.integers(0, 100))
def test_the_step_of_a_converter_is_found_from_the_values_that_occur(step: float, seed: int) -> None:
    y = rounded(step * np.round(signal(seed) / step))
    assert converter_step(y) == pytest.approx(step, rel=1e-3)


@given(seed=st.integers(0, 100))
@settings(max_examples=10)
def test_readings_written_with_six_digits_have_no_step_no_run_and_no_spike(seed: int) -> None:
    y = rounded(signal(seed))
    assert converter_step(y) == 0.0
    assert not frozen_rows(y).any()
    assert spikes(y, np.ones(y.size, dtype=bool)).sum() == 0


def test_frozen_readings_are_left_out_and_named_with_their_times() -> None:
    y = rounded(signal(1))
    for first in (500, 1200, 2000):
        y[first : first + 8] = y[first - 1]
    r = Recording(t=0.01 * np.arange(y.size), u=np.zeros(y.size), y=y)
    good, effects = inspect([r])
    assert [e.name for e in effects] == ["sensor.dropout"]
    assert (~good[0]).sum() == 24
    assert effects[0].windows[0] == pytest.approx((0, 5.0, 5.08))


@pytest.mark.parametrize("share", [0.02, 0.1, 0.27])
def test_samples_that_are_lost_often_are_lost_all_the_same(share: float) -> None:
    rng, y = np.random.default_rng(3), rounded(signal(3))
    for first in np.flatnonzero(rng.uniform(size=y.size - 4) < share / 3.0):
        y[first + 1 : first + 4] = y[first]
    _, effects = inspect([Recording(t=0.01 * np.arange(y.size), u=np.zeros(y.size), y=y)])
    assert [e.name for e in effects] == ["sensor.dropout"]
    assert effects[0].parameters["share"].value == pytest.approx(share, rel=0.2)


@pytest.mark.parametrize("rows", [3, 4, 10])
def test_a_converter_slower_than_the_recording_loses_no_samples(rows: int) -> None:
    rng, fresh = np.random.default_rng(4), rounded(signal(4))
    jumps = np.cumsum(rng.integers(rows - 1, rows + 2, fresh.size))  # its clock is not the recorder's
    y = fresh[np.searchsorted(jumps, np.arange(fresh.size), side="right")]
    _, effects = inspect([Recording(t=0.01 * np.arange(y.size), u=np.zeros(y.size), y=y)])
    assert effects == []


def test_a_reading_that_stands_once_at_its_largest_value_met_an_end_stop() -> None:
    k, level = np.arange(3000), 5.9
    growing = 5.0 + (0.5 + k / 6000.0) * np.sin(0.01 * k) + 0.001 * np.random.default_rng(1).normal(size=k.size)
    y = rounded(np.minimum(growing, level))  # only the last crest reaches it
    r = Recording(t=0.01 * k, u=np.zeros(y.size), y=y)
    _, effects = inspect([r])
    assert [e.name for e in effects] == ["sensor.saturation"]
    assert effects[0].parameters["high"].value == pytest.approx(level)


def test_what_is_not_looked_for_is_left_in_the_readings() -> None:
    y = rounded(signal(1))
    for first in (500, 1200, 2000):
        y[first : first + 8] = y[first - 1]
    good, effects = inspect([Recording(t=0.01 * np.arange(y.size), u=np.zeros(y.size), y=y)], ["sensor.dropout"])
    assert not effects
    assert good[0].all()


def test_spikes_are_left_out_and_their_size_is_told() -> None:
    y = rounded(signal(2))
    rows = np.array([300, 900, 1500, 2100, 2700])
    y[rows] += 0.6 * np.array([1, -1, 1, -1, 1])
    r = Recording(t=0.01 * np.arange(y.size), u=np.zeros(y.size), y=y)
    good, effects = inspect([r])
    assert [e.name for e in effects] == ["sensor.outliers"]
    assert np.array_equal(np.flatnonzero(~good[0]), rows)
    assert effects[0].parameters["size"].value == pytest.approx(0.6, rel=0.1)


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6])
def test_first_differences_tell_the_noise_under_a_slow_residual(rho: float) -> None:
    rng = np.random.default_rng(5)
    n = np.zeros(8000)
    for k in range(1, n.size):
        n[k] = rho * n[k - 1] + rng.normal()
    good = [np.ones(n.size, dtype=bool)]
    slow = 10.0 * np.sin(np.arange(n.size) * 0.01)
    noise = noise_from_differences([n + slow], good)
    assert noise.sd == pytest.approx(1.0, rel=0.05)
    assert noise.ar[0] == pytest.approx(rho, abs=0.06)
    assert noise.total_sd == pytest.approx(1.0 / np.sqrt(1.0 - rho**2), rel=0.08)


def test_yule_walker_recovers_an_autoregressive_noise() -> None:
    rng = np.random.default_rng(6)
    n = np.zeros(20000)
    for k in range(2, n.size):
        n[k] = 0.4 * n[k - 1] + 0.2 * n[k - 2] + 2.0 * rng.normal()
    noise = autoregressive_up_to([n], [np.ones(n.size, dtype=bool)], 2)[-1]
    assert noise.sd == pytest.approx(2.0, rel=0.02)
    assert noise.ar == pytest.approx((0.4, 0.2), abs=0.03)


@pytest.mark.parametrize(("step", "share"), [(2.0, 0.1), (5.0, 0.12), (8.0, 0.25)])
def test_the_noise_of_readings_behind_a_coarse_converter_is_what_it_leaves(step: float, share: float) -> None:
    # noise of 1 on a signal that changes by 0.3 a row, rounded to several times the noise: most readings stay
    rng = np.random.default_rng(4)
    clean = 20.0 * np.sin(0.015 * np.arange(6000))
    left = step * np.round((clean + rng.normal(size=clean.size)) / step) - clean
    noise = noise_from_differences([left], [np.ones(left.size, dtype=bool)])
    assert noise.total_sd == pytest.approx(float(np.std(left)), rel=share)


def test_a_few_jumps_are_no_noise() -> None:
    rng = np.random.default_rng(4)
    left = rng.normal(size=4000)
    left[::50] += 30.0 * rng.choice([-1.0, 1.0], size=80)
    noise = noise_from_differences([left], [np.ones(left.size, dtype=bool)])
    assert noise.total_sd < 1.5
