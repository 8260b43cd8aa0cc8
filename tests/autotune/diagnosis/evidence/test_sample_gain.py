"""What single samples show is named where simulations of the runs that it spoils speak for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.evidence.adequacy import strongest_line
from autotune.diagnosis.evidence.operating_point import offset_of
from autotune.diagnosis.evidence.sample_gain import rows_of, select_supported
from autotune.diagnosis.evidence.samples import SampleEffect, inspect, outliers_in, unspoiled_rows
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.thresholds import IN_USE
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

DT, TAU, ROWS, STEP = 0.1, 2.0, 1500, 0.05
Change = Callable[[np.ndarray], np.ndarray]


def process() -> Model:
    return Model(
        name="process",
        input=Port(unit="V"),
        output=Port(unit="V"),
        blocks=(Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(TAU, 1.0))),),
    )


def recorded(change: Change, noise: float = 0.01, seed: int = 1, command: np.ndarray | None = None) -> Recording:
    """Return a first-order process that steps every 6 s, its reading changed."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 60 + 1), 60)[:ROWS] if command is None else command
    x, states, faded = 0.0, np.empty(ROWS), math.exp(-DT / TAU)
    for k in range(ROWS):
        states[k] = x
        x = u[k] + (x - u[k]) * faded
    return Recording(t=DT * np.arange(ROWS), u=u, y=change(states + noise * rng.normal(size=ROWS)))


def rounded(y: np.ndarray) -> np.ndarray:
    return np.round(STEP * np.round(y / STEP), 6)


def lost(y: np.ndarray) -> np.ndarray:
    """Lose 14 readings at the beginning of every second step."""
    y = y.copy()
    for first in range(62, ROWS - 20, 120):
        y[first : first + 14] = y[first - 1]
    return y


def spiked(y: np.ndarray) -> np.ndarray:
    y = y.copy()
    y[[200, 500, 800, 1100, 1400]] += 0.8 * np.array([1.0, -1.0, 1.0, 1.0, -1.0])
    return y


def named(r: Recording, model: Model | None = None) -> dict[str, SampleEffect]:
    good, seen = inspect([r])
    data, retuned = prepare(process() if model is None else model, [r], good)
    return {one.name: one for one in select_supported(seen, rows_of(retuned, data))}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("sensor.dropout", lost),
        ("sensor.outliers", spiked),
        ("sensor.saturation", lambda y: np.minimum(y, 0.4)),
    ],
)
def test_what_spoils_readings_is_found_before_a_converter_too(name: str, change: Change) -> None:
    for r in (recorded(change), recorded(lambda y: rounded(change(y)))):
        assert named(r)[name].speaks > 3.0
    assert name not in named(recorded(rounded))
    assert name not in named(recorded(lambda y: y))


def test_a_plant_at_rest_behind_a_converter_loses_no_reading_and_meets_no_limit() -> None:
    u = np.repeat([0.0, 1.0, 0.0, 1.0, 0.0], ROWS // 5)
    r = recorded(rounded, noise=0.001, command=u)
    assert set(named(r)) <= {"sensor.quantisation"}


@pytest.mark.parametrize("height", [0.2, 0.4, 0.8])
@pytest.mark.parametrize("rows", [2, 3])
def test_spikes_of_several_rows_after_rest_are_no_lost_readings(height: float, rows: int) -> None:
    """The reading jumps when it is back, by ten times what it usually changes; the plant has not gone anywhere."""
    fine = recorded(lambda y: 0.02 * np.round(y / 0.02), noise=0.001, command=np.repeat([0.0, 1.0] * 6, ROWS // 12))
    y = fine.y.copy()
    for first in range(110, ROWS - 10, 125):
        y[first : first + rows] += height
    lost_readings = named(replace(fine, y=y)).get("sensor.dropout")
    clear = 2.0 * math.log(IN_USE.decided / (1.0 - IN_USE.decided))
    assert lost_readings is None or lost_readings.speaks < clear


def test_spikes_that_are_small_beside_the_models_error_are_not_named() -> None:
    r = recorded(spiked)
    wrong = replace(r, u=np.cumsum(np.random.default_rng(3).normal(size=ROWS)))  # says nothing of y
    assert "sensor.outliers" in named(r)
    _, seen = inspect([wrong])
    assert [one.name for one in seen] == ["sensor.outliers"]
    assert "sensor.outliers" not in named(wrong)


def test_spikes_that_a_moving_reading_hides_stand_out_of_the_residual() -> None:
    """A reading that swings within some rows lies far from its neighbours' mean wherever it turns."""
    swinging = 1.3 * np.sin(2.0 * np.pi * np.arange(ROWS) / 8.0)
    rows = np.arange(100, 1400, 130)

    def hidden(y: np.ndarray) -> np.ndarray:
        y = y.copy()
        y[rows] += 0.11 * (-1.0) ** np.arange(rows.size)
        return y

    r = recorded(hidden, command=swinging)
    good, seen = inspect([r])
    assert seen == []
    data, retuned = prepare(process(), [r], good)
    left = [r.y - retuned.signals[0][:, 0]]
    outliers = outliers_in(left, [r], data.good, IN_USE)
    assert outliers is not None
    assert np.array_equal(np.flatnonzero(outliers.rows[0]), rows)
    assert select_supported([outliers], rows_of(retuned, data))
    assert np.array_equal(np.flatnonzero(~unspoiled_rows([r], [outliers])[0]), rows)


def fitted(r: Recording) -> tuple[Data, Fit]:
    return prepare(process(), [r], [np.isfinite(r.y)])


@pytest.mark.parametrize("seed", range(3))
def test_a_residual_of_noise_has_no_line_and_one_that_swings_with_the_signal_has(seed: int) -> None:
    quiet, swings = recorded(lambda y: y, seed=seed), 0.006 * np.sin(2.0 * np.pi * np.arange(ROWS) / 14.0)
    for r, has_line in ((quiet, False), (replace(quiet, y=quiet.y + swings), True)):
        data, retuned = fitted(r)
        assert (strongest_line(retuned, data) > IN_USE.line) is has_line


def test_an_offset_that_wanders_off_is_none_that_stands() -> None:
    wandering = np.linspace(0.0, 0.6, ROWS)
    r = recorded(lambda y: y)
    standing = offset_of(fitted(replace(r, u=r.u + 0.3))[1])
    assert standing is not None
    assert standing.value == pytest.approx(-0.3, abs=0.02)
    assert offset_of(fitted(replace(r, y=r.y - wandering))[1]) is None
