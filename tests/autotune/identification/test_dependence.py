from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from typer.testing import CliRunner

import autotune as at
from autotune.arrays import FloatArray
from autotune.cli import app
from autotune.errors import IdentificationError
from autotune.identification.answer import (
    follows_in_row,
    only_follows,
    recorded_dependence,
    require_answer,
    require_order,
)
from autotune.identification.dependence import dependence
from autotune.recording import Recording, write_recording
from tests.benchmarks.surrogates import surrogate

ROWS = 800


def recorded(u: FloatArray, y: FloatArray, **columns: FloatArray) -> Recording:
    return Recording(t=np.arange(u.size, dtype=float), u=u, y=y, extra=columns, name="r")


def moves(rng: np.random.Generator) -> dict[str, FloatArray]:
    return {
        "white": rng.standard_normal(ROWS),
        "steps": np.repeat(rng.choice([4.5, 5.5], ROWS // 20), 20),
        "random walk": np.cumsum(rng.standard_normal(ROWS)),
        "square": np.sign(np.sin(np.arange(ROWS) / 6.0)),
        "multisine": sum((np.cos(0.03 * k * np.arange(ROWS) + k * k) for k in (1, 3, 5, 7)), np.zeros(ROWS)),
    }


def strangers(rng: np.random.Generator) -> dict[str, FloatArray]:
    w = rng.standard_normal
    return {
        "white": w(ROWS),
        "autoregressive": lfilter([1.0], [1.0, -0.95], w(ROWS)),
        "resonant": lfilter([1.0], [1.0, -1.9, 0.95], w(ROWS)),
        "random walk": np.cumsum(w(ROWS)),
        "drifting": np.linspace(0.0, 5.0, ROWS) + 0.3 * w(ROWS),
        "quantised": np.round(lfilter([1.0], [1.0, -0.98], w(ROWS))),
    }


def test_a_y_that_runs_on_by_itself_is_never_held_for_an_answer() -> None:
    """300 pairs at 1 in 1,000 each; the bound over lags and sums is far from reached."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        for u in moves(rng).values():
            for y in strangers(rng).values():
                assert not dependence(u, y).answers


@pytest.mark.parametrize("name", ["oven", "loop", "delay", "two delays"])
def test_the_examples_answer(name: str) -> None:
    require_answer([at.example(name)])


@pytest.mark.parametrize("kind", ["white", "steps", "random walk"])
@pytest.mark.parametrize("gain", [2.0, -2.0])
def test_a_plant_under_its_own_noise_answers_with_its_sign_at_its_delay(kind: str, gain: float) -> None:
    rng = np.random.default_rng(3)
    u = moves(rng)[kind]
    late = np.concatenate([np.full(5, u[0]), u[:-5]])
    y = gain * lfilter([0.1], [1.0, -0.9], late - u[0]) + 0.05 * rng.standard_normal(ROWS)
    found = dependence(u, y)
    assert found.answers
    assert found.sign == np.sign(gain)
    assert 1 <= found.lag <= 12


def closed_loop(seed: int, setpoint: bool) -> Recording:
    """Simulate a PI loop of a lag and dead time of 3 rows under coloured noise."""
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-1.0, 1.0], ROWS // 40), 40) if setpoint else np.zeros(ROWS)
    u, y = np.zeros(ROWS), np.zeros(ROWS)
    x = noise = total = 0.0
    for k in range(ROWS):
        x = 0.9 * x + 0.1 * (u[k - 4] if k > 3 else 0.0)
        noise = 0.9 * noise + 0.1 * rng.standard_normal()
        y[k] = x + noise
        total += 0.05 * (r[k] - y[k])
        u[k] = r[k] - y[k] + total
    return recorded(u, y, r=r)


def test_a_loop_that_only_its_own_noise_drives_says_nothing_of_the_plant() -> None:
    for seed in range(10):
        with pytest.raises(IdentificationError, match="u does nothing but follow y"):
            require_answer([closed_loop(seed, setpoint=False)])
        assert only_follows([closed_loop(seed, setpoint=False)])


def level_loop(seed: int) -> Recording:
    """Simulate a level under coloured noise; a PI controller lets more out where it is high, as its command strays."""
    rng = np.random.default_rng(seed)
    u, y = np.zeros(750), np.zeros(750)
    level = noise = total = 0.0
    for k in range(750):
        noise = 0.8 * noise + rng.standard_normal()
        y[k] = level + noise
        total += 0.02 * y[k]
        u[k] = y[k] + total + rng.standard_normal()
        level -= 0.01 * u[k]
    return recorded(u, y)


@pytest.mark.parametrize("seed", [5, 23])
def test_a_chance_relation_does_not_hide_that_u_follows_y_within_its_row(seed: int) -> None:
    loop = level_loop(seed)
    found = recorded_dependence(loop)
    assert not found.answers
    assert (found.lag, found.sign) == (1, 1)  # where y answers, the sign of a plant that acted within the row
    assert found.follows_in_row
    require_order([loop])  # said to be swapped before: seed 5


def test_a_loop_whose_setpoint_moves_answers() -> None:
    loop = closed_loop(1, setpoint=True)
    require_answer([loop])
    assert recorded_dependence(loop).answers
    assert not only_follows([loop])


def test_what_the_columns_say_instead_is_said() -> None:
    oven = at.example("oven")
    with pytest.raises(IdentificationError, match=r"seem swapped.*--u and --y"):
        require_answer([replace(oven, u=oven.y, y=oven.u)])
    with pytest.raises(IdentificationError, match="one signal under two names"):
        require_answer([replace(oven, y=7.0 - 3.0 * oven.u)])
    with pytest.raises(IdentificationError, match="the command never changes"):
        require_answer([replace(oven, u=np.ones(len(oven)))])
    with pytest.raises(IdentificationError, match="nothing to do with u beyond chance"):
        require_answer([replace(oven, y=np.random.default_rng(1).standard_normal(len(oven)))])


def test_one_recording_that_answers_is_enough() -> None:
    oven = at.example("oven")
    require_answer([oven, replace(oven, u=np.ones(len(oven)))])


@pytest.mark.parametrize("factor", [1e-9, 1.0, 1e9])
def test_the_answer_does_not_hang_on_units_or_the_last_digits(factor: float) -> None:
    oven = at.example("oven")
    here = dependence(oven.u, oven.y)
    there = dependence(oven.u * factor, np.round(oven.y, 8) / factor)
    assert there.lag == here.lag
    assert abs(np.log(there.forward) - np.log(here.forward)) < 0.01 * abs(np.log(here.forward))


@given(st.floats(-14.0, 14.0), st.floats(-14.0, 14.0))
@settings(max_examples=8, deadline=None)
def test_a_model_in_other_units_is_the_same_model(of_u: float, of_y: float) -> None:
    """From picoamperes in ampere to teraohms in ohm: an output of less than 1e-12 was called constant."""
    by_u, by_y = 10.0**of_u, 10.0**of_y
    oven, loop = at.example("oven"), at.example("loop")
    here, there = at.delay(oven), at.delay(replace(oven, u=by_u * oven.u, y=by_y * oven.y))
    assert there.delay_s == pytest.approx(here.delay_s, rel=1e-3)
    assert there.b == pytest.approx(here.b * by_y / by_u, rel=1e-3)
    other = replace(loop, u=by_u * loop.u, y=by_y * loop.y, extra={"r": by_y * loop["r"]})
    for fit in (at.frequency_points, partial(at.closed_loop, order=3)):
        one, two = fit(loop), fit(other)
        one, two = (found if isinstance(found, tuple) else found.response for found in (one, two))
        assert [p.response for p in two] == pytest.approx([p.response * by_y / by_u for p in one], rel=1e-3)


@pytest.mark.parametrize("gain", [2.0, -2.0])
@pytest.mark.parametrize("lag", [1.0, 3.0, 30.0])
def test_a_plant_that_answers_within_a_row_is_no_controller(lag: float, gain: float) -> None:
    """Rows in which u acted before y was measured, whether the recording says so or not."""
    keep = float(np.exp(-1.0 / lag))
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u = moves(rng)["steps"]
        y = gain * lfilter([1.0 - keep], [1.0, -keep], u - u[0]) + 0.05 * rng.standard_normal(ROWS)
        open_loop = recorded(u, y)
        assert not follows_in_row(open_loop)
        assert not follows_in_row(replace(open_loop, metadata={"hold": "linear"}))
        assert len(at.frequency_points(open_loop)) > 0


def test_under_a_controller_u_follows_y_within_its_row() -> None:
    for seed in range(10):
        assert follows_in_row(closed_loop(seed, setpoint=False))
        assert follows_in_row(closed_loop(seed, setpoint=True))


def test_of_a_handful_of_rows_nothing_is_said_but_that_they_are_too_few() -> None:
    few = Recording(t=np.arange(3.0), u=np.array([4.0, 4.0, 6.0]), y=np.array([50.0, 50.0, 51.0]), name="few")
    with pytest.raises(IdentificationError, match="3 rows are too few to tell whether y answers u"):
        require_answer([few])


@pytest.mark.parametrize("family", ["white", "autoregressive", "random walk", "swapped"])
def test_no_frequency_points_are_stated_where_y_does_not_answer_u(family: str, tmp_path: Path) -> None:
    write_recording(surrogate(family, 5), tmp_path / "r.csv")
    done = CliRunner().invoke(app, ["identify", "frequency", f"{tmp_path}/r.csv", "--out", f"{tmp_path}/p.json"])
    assert isinstance(done.exception, IdentificationError)
    assert not (tmp_path / "p.json").exists()


@pytest.mark.parametrize("family", ["white", "autoregressive", "random walk", "swapped"])
@pytest.mark.parametrize(
    "fit", [at.frequency_points, at.delay, at.closed_loop, partial(at.closed_loop, method="pbsid")]
)
def test_no_function_fits_what_does_not_answer(fit: Callable[[Recording], object], family: str) -> None:
    with pytest.raises(IdentificationError, match=r"nothing to do with u beyond chance|seem swapped"):
        fit(surrogate(family, 5))
