"""Recorded columns that a model does not have: which of them acts, where, and how large."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.arrays import FloatArray
from autotune.diagnosis import diagnose
from autotune.diagnosis.equations.further import further_columns
from autotune.equations.chain import chain_with_inputs
from autotune.equations.files import forecast_any
from autotune.model_file import read_any
from autotune.recording import Recording
from tests.autotune.equations.models import model, one_state

GAIN = 0.02
CHAIN = {
    "name": "belt", "input": [{"column": "u", "unit": "V"}, {"column": "slope", "num": [0.5], "den": [0.3, 1.0]}],
    "output": {"unit": "m"},
    "block": [
        {"name": "speed", "place": "plant", "num": [2.0], "den": [0.4, 1.0], "unit": "m/s"},
        {"name": "position", "place": "plant", "num": [1.0], "den": [1.0, 0.0], "unit": "m"},
    ],
}  # fmt: skip


def slow_noise(seed: int, rows: int, share: float = 0.02) -> FloatArray:
    """Return a signal that wanders, of about unit size."""
    random, x = np.random.default_rng(seed), np.zeros(rows)
    steps = random.normal(size=rows) * np.sqrt(2.0 * share)
    for k in range(1, rows):
        x[k] = (1.0 - share) * x[k - 1] + steps[k]
    return x


def tank(seed: int, lag_s: float, at: str, rows: int = 1500) -> Recording:
    """T dh/dt = K u - h with a share of a recorded flow, behind a lag, at the derivative or beside the reading."""
    random, t = np.random.default_rng(seed), 0.2 * np.arange(rows)
    u, flow = np.repeat(random.normal(1.0, 0.3, rows // 30), 30), 3.0 + slow_noise(seed + 50, rows)
    h, passed, y = 1.0, flow[0], np.empty(rows)
    for k in range(rows):
        y[k] = h + (GAIN * (passed - 3.0) if at == "reading" else 0.0)
        for i in range(1, 21):  # what is measured runs straight from row to row
            now = flow[k] + i / 20 * (flow[min(k + 1, rows - 1)] - flow[k])
            passed += 0.01 * (now - passed) / lag_s if lag_s else now - passed
            h += 0.01 * ((u[k] - h) / 5.0 + (GAIN * (passed - 3.0) if at == "x" else 0.0))
    extra = {"flow": flow, "other": slow_noise(seed + 90, rows), "level_mm": 1000.0 * y, "still": np.full(rows, 4.0)}
    return Recording(t=t, u=u, y=y + 0.005 * random.normal(size=rows), extra=extra, name=f"rec{seed}.csv")


def tank_model() -> object:
    return one_state("(K*u - x)/T", {"K": {"value": 1.1}, "T": {"value": 4.0}})


@pytest.mark.parametrize(("lag_s", "at"), [(0.0, "x"), (3.0, "x"), (0.0, "reading")])
def test_the_column_that_acts_is_named_with_its_place_its_gain_and_its_lag(lag_s: float, at: str) -> None:
    found = diagnose(tank_model(), [tank(1, lag_s, at), tank(2, lag_s, at)])
    (effect,) = found.as_json()["effects"]
    assert (effect["name"], effect["column"]) == ("environment.measured_input", "flow")
    assert effect["state"] == ("x" if at == "x" else None)
    assert effect["probability"] > 0.9
    assert effect["parameters"]["gain"]["value"] == pytest.approx(GAIN, rel=0.05)
    assert ("time_constant" in effect["parameters"]) is (lag_s > 0.0)
    if lag_s:
        assert effect["parameters"]["time_constant"]["value"] == pytest.approx(lag_s, rel=0.1)
    extended, unseen = found.extended_model, tank(3, lag_s, at)
    assert [one.column for one in extended.inputs] == ["u", "flow"]
    assert np.std(unseen.y - forecast_any(extended, unseen)) < 0.007
    assert np.std(unseen.y - forecast_any(tank_model(), unseen)) > 0.014


def test_the_extended_model_is_a_file_that_names_the_column(tmp_path: Path) -> None:
    from autotune.equations.files import write_any

    found = diagnose(tank_model(), [tank(1, 3.0, "x")])
    write_any(found.extended_model, tmp_path / "extended.toml")
    again = read_any(tmp_path / "extended.toml")
    assert again.effects[0].column == "flow"
    unseen = tank(4, 3.0, "x")
    np.testing.assert_allclose(
        forecast_any(again, unseen), forecast_any(found.extended_model, unseen), rtol=1e-5, atol=1e-6
    )
    with pytest.raises(Exception, match="flow"):
        forecast_any(again, replace(unseen, extra={}))


def test_a_column_that_does_nothing_is_not_named() -> None:
    r = [replace(one, extra={"other": one["other"]}) for one in (tank(5, 0.0, "none"), tank(6, 0.0, "none"))]
    assert diagnose(tank_model(), r).verdict == "parameters"


def test_what_is_a_signal_of_the_model_already_is_no_further_column() -> None:
    r = tank(7, 0.0, "none")
    twin = r.u * 3.0 - 1.0
    r = replace(r, extra={**r.extra, "x": r.y, "r": r.u, "u_applied": r.u, "twin": twin, "sin": r["other"], "a b": r.y})
    assert further_columns(tank_model(), [r]) == ("flow", "other")
    assert further_columns(tank_model(), [r, replace(r, extra={"flow": r["flow"]})]) == ("flow",)
    assert further_columns(model(), [replace(r, extra={"J": r["flow"]})]) == ()


def test_a_chain_with_a_measured_disturbance_finds_friction_and_further_columns() -> None:
    """The states of a chain say what they are, so that physics can act on them."""
    chain = chain_with_inputs(CHAIN, "belt.toml")
    assert [(one.name, one.kind, one.of) for one in chain.states if one.kind != "other"] == [
        ("speed", "speed", "position"), ("position", "position", "")]  # fmt: skip

    def belt(seed: int, friction: float, wind: float, rows: int = 750) -> Recording:
        random, t = np.random.default_rng(seed), 0.02 * np.arange(rows)
        u, slope, air = (
            np.repeat(random.normal(0.0, 1.0, rows // 50), 50), slow_noise(seed + 9, rows), slow_noise(seed + 5, rows)
        )  # fmt: skip
        v = x = w = 0.0
        y = np.empty(rows)
        for k in range(rows):
            y[k] = x
            for _ in range(20):
                push = (2.0 * (u[k] + w) - v) / 0.4 + wind * air[k]
                v_new = v + 0.001 * push
                stop = 0.001 * friction
                v = 0.0 if abs(v_new) <= stop else v_new - np.sign(v_new) * stop
                x += 0.001 * v
                w += 0.001 * (0.5 * slope[k] - w) / 0.3
        return Recording(t=t, u=u, y=y + 0.001 * random.normal(size=rows), extra={"slope": slope, "air": air})

    found = diagnose(chain, [belt(1, 1.0, 0.0), belt(2, 1.0, 0.0)])
    assert [(e.name, e.state) for e in found.effects] == [("plant.coulomb_friction", "speed")]
    assert found.effects[0].parameters["level"].value == pytest.approx(1.0, rel=0.05)
    found = diagnose(chain, [belt(3, 0.0, 0.7), belt(4, 0.0, 0.7)])
    assert [(e.name, e.column) for e in found.effects] == [("environment.measured_input", "air")]
