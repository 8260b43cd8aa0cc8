"""Diagnoses of rigs written down here by their own equations, and of recordings beside the checkout."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.simulation.forecast import forecast
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import CATALOGUE
from autotune.experiment_design import with_next_experiment
from autotune.model_tables import read_model
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording, read_recording


def servo(gain: float = 5.0, tau: float = 0.25) -> Model:
    return Model(
        name="servo",
        input=Port(unit="V"),
        output=Port(unit="rad"),
        blocks=(
            Block(name="mass", place="plant", dynamics=TransferFunction(num=(gain,), den=(tau, 1.0))),
            Block(name="position", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0))),
        ),
    )


def rig(seed: int, drag: float = 0.0, rows: int = 1500, noise: float = 0.01, along: float = 0.0) -> Recording:
    """tau dv/dt = -v - drag v |v| + gain (1 + along x) u under a P controller, by RK4, five steps in a sample time."""
    rng = np.random.default_rng(seed)
    dt, gain, tau, K = 0.02, 5.4, 0.23, 0.9
    v = x = 0.0
    u, y = np.empty(rows), np.empty(rows)
    aim = np.repeat(rng.uniform(-2.0, 2.0, rows // 100 + 1), 100)[:rows]
    for k in range(rows):
        y[k] = x + noise * rng.normal()
        u[k] = K * (aim[k] - y[k]) + 0.3 * np.sin(5.0 * k * dt)

        def slope(v: float, x: float, push: float = u[k]) -> float:
            return (-v - drag * v * abs(v) + gain * (1.0 + along * x) * push) / tau

        for _ in range(5):
            h = dt / 5
            k1 = slope(v, x)
            k2 = slope(v + 0.5 * h * k1, x + 0.5 * h * v)
            k3 = slope(v + 0.5 * h * k2, x + 0.5 * h * v)
            k4 = slope(v + h * k3, x + h * v)
            x += h * (v + h / 6.0 * (k1 + k2 + k3))
            v += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return Recording(t=dt * np.arange(rows), u=u, y=y)


def test_wrong_numbers_are_called_parameters_and_the_extended_model_has_the_right_ones() -> None:
    found = diagnose(servo(), [rig(1), rig(2)])
    assert found.verdict == "parameters"
    assert found.effects == ()
    gain = found.extended_model.blocks[0].dynamics.num[0]
    assert gain == pytest.approx(5.4, rel=0.01)


def test_a_recording_that_is_retuned_in_some_of_its_windows_is_diagnosed() -> None:
    limits = replace(IN_USE, searched_rows=400, rig_rows=400)
    others = [n for n in CATALOGUE if n != "plant.quadratic_drag"]
    found = diagnose(servo(), [rig(1, drag=0.12)], without=others, thresholds=limits)
    assert [e.name for e in found.effects] == ["plant.quadratic_drag"]


def test_a_drag_left_out_is_named_with_its_coefficient() -> None:
    found = diagnose(servo(), [rig(3, drag=0.15), rig(4, drag=0.15)])
    assert found.verdict == "effect"
    assert found.effects[0].name == "plant.quadratic_drag"
    coefficient = found.effects[0].parameters["coefficient"]
    assert abs(coefficient.value - 0.15) < 4.0 * coefficient.sd + 0.005
    assert found.fit.extended < 1.1 * found.fit.noise_floor < found.fit.retuned
    assert not found.withheld


def test_an_extended_model_has_the_numbers_of_the_finding() -> None:
    name = "plant.position_dependent_gain"
    found = diagnose(servo(), [rig(4, along=0.12), rig(5, along=0.12)], without=[n for n in CATALOGUE if n != name])
    (effect,) = found.effects
    slope = effect.parameters["slope"].value
    assert slope == pytest.approx(0.12, rel=0.03)
    assert found.extended_model.effects[0].values["slope"] == slope


def test_intervals_of_the_retuned_gain_cover_the_truth_in_closed_loop() -> None:
    inside = 0
    for seed in range(30):
        r = rig(100 + seed, rows=600)
        _, result = prepare(servo(), [r], inspect([r])[0])
        gain, sd = result.theta[0], np.sqrt(result.covariance[0, 0])
        inside += bool(abs(gain - np.log(5.4 / 5.0)) < 1.96 * sd)
    assert 25 <= inside <= 30  # 95 % of 30 are 28.5; fewer than 25 have a chance of 0.3 %


def test_a_plant_that_only_integrates_has_no_lag_and_is_diagnosed() -> None:
    """No time constant tells which lags and loads to try."""
    random = np.random.default_rng(1)
    t, u = 0.1 * np.arange(600), np.repeat(random.normal(size=30), 20)
    acts = u - np.clip(u, -0.4, 0.4)
    y = np.concatenate([[0.0], np.cumsum(0.1 * acts)[:-1]]) + 0.01 * random.normal(size=600)
    block = Block(name="tank", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0)))
    model = Model(name="tank", input=Port(unit="V"), output=Port(unit="cm"), blocks=(block,))
    found = diagnose(model, [Recording(t=t, u=u, y=y)])
    assert [effect.name for effect in found.effects] == ["actuator.dead_zone"]


def test_a_fit_with_nothing_free_but_the_start_states_leaves_the_numbers_alone() -> None:
    r = rig(7, rows=600)
    data, result = prepare(servo(), [r], inspect([r])[0])
    none = np.zeros(result.theta.size, dtype=bool)
    fixed = fit(result.parametrisation, data, free=none)
    np.testing.assert_array_equal(fixed.theta, result.parametrisation.centre)
    assert fixed.chi2 > result.chi2


def test_a_clean_practice_case_needs_nothing(shared: Path, tmp_path: Path) -> None:
    case = shared / "practice_cases" / "case_001"
    given = [
        "diagnose",
        "--model",
        f"{case}/model.toml",
        f"{case}/rec1.csv",
        f"{case}/rec2.csv",
        "--out",
        f"{tmp_path}/d",
    ]
    assert CliRunner().invoke(app, given).exit_code == 0
    said = json.loads((tmp_path / "d" / "diagnosis.json").read_text())
    assert said["verdict"] == "none"
    assert said["effects"] == []
    assert (tmp_path / "d" / "report.html").stat().st_size > 10_000
    unseen = ["simulate", "--model", f"{tmp_path}/d/extended_model.toml", f"{case}/unseen.csv", "--horizon", "2"]
    assert CliRunner().invoke(app, [*unseen, "--out", f"{tmp_path}/sim.csv"]).exit_code == 0
    sim = np.genfromtxt(tmp_path / "sim.csv", delimiter=",", names=True)
    y = read_recording(case / "unseen.csv").y
    assert np.std((sim["y_sim"] - y)[200:]) / np.std(y[200:]) < 0.033  # the answer's figure for the truth is 0.0312


def test_a_lag_is_named_with_all_the_places_it_may_sit(shared: Path) -> None:
    case = shared / "practice_cases" / "case_009"
    recordings = [read_recording(case / f"rec{k}.csv") for k in (1, 2)]
    found = with_next_experiment(diagnose(read_model(case / "model.toml"), recordings))
    lag = found.effects[0]
    assert lag.name in ("actuator.lag", "sensor.lag")
    assert lag.probability - 1e-9 <= lag.together <= 1.0
    assert {"actuator", "sensor"} <= set(found.places)
    assert found.next_experiment is not None


def tube(seed: int) -> Recording:
    """Return 40 s of a ball in a tube by its own equations, its lift falling by 0.12 of the height per second."""
    rng = np.random.default_rng(seed)
    rows, dt, air, speed, height = 1600, 0.025, 0.0, 0.0, 0.0
    u, y = np.repeat(rng.choice([-4.0, 4.0], rows // 40), 40), np.empty(rows)
    for k in range(rows):
        y[k] = height + 3.0 * rng.normal()
        for _ in range(10):
            air += 0.1 * dt * (u[k] - air) / 0.25
            speed += 0.1 * dt * (5.5 * air - 0.12 * height - speed) / 0.1
            height += 0.1 * dt * speed
    return Recording(t=dt * np.arange(rows), u=u, y=y)


def test_the_rate_at_which_lift_falls_has_no_bias_and_an_honest_interval() -> None:
    def block(name: str, place: str, num: float, den: tuple[float, float]) -> Block:
        return Block(name=name, place=place, dynamics=TransferFunction(num=(num,), den=den))

    chain = (
        block("fan", "actuator", 1.0, (0.25, 1.0)), block("ball speed", "plant", 5.5, (0.1, 1.0)),
        block("ball height", "plant", 1.0, (1.0, 0.0)),
    )  # fmt: skip
    model = Model(name="ball in tube", input=Port(unit="%"), output=Port(unit="mm"), blocks=chain)
    rest = [name for name in CATALOGUE if name != "plant.leak"]
    found = [diagnose(model, [tube(seed)], without=rest) for seed in range(10)]
    rates = [one.effects[0].parameters["rate"] for one in found]
    error = np.array([rate.value - 0.12 for rate in rates])
    sd = np.array([rate.sd for rate in rates])
    assert abs(np.mean(error)) < 2.6 * np.sqrt(np.mean(sd**2) / 10)  # 99 %
    assert 2.16 < np.sum((error / sd) ** 2) < 25.2  # chi-square of ten, 99 %


def test_the_lift_that_falls_with_height_is_in_what_explains_a_real_tube(shared: Path) -> None:
    """It is not named: what explains y best errs as much with commands that stand still in the rows left out."""
    folder = shared / "data" / "floatshield"
    found = diagnose(read_model(folder / "model_2.toml"), [read_recording(folder / "fit_2.csv")])
    assert "plant.leak" in found.search.others[0].names
    assert (found.verdict, found.effects) == ("unexplained", ())
    # on the half that no fit has seen; a linear model has 0.212 there
    unseen = read_recording(folder / "test_2.csv")
    scored = unseen.t >= 3.0
    error = float(np.std((forecast(found.extended_model, unseen, 3.0) - unseen.y)[scored]) / np.std(unseen.y[scored]))
    assert error < 0.212


def test_a_ball_that_lies_on_the_floor_for_a_third_of_the_time_leaves_open_how_its_lift_falls(shared: Path) -> None:
    """The whole recording finds a leak of the height, one part a gain over position, the other a floor."""
    folder = shared / "data" / "floatshield"
    found = diagnose(read_model(folder / "model.toml"), [read_recording(folder / "fit_1.csv")])
    assert (found.verdict, found.effects) == ("unexplained", ())
    assert "plant.leak" in {name for c in found.candidates for name in c.name.split("+")}


@pytest.mark.timeout(900)  # three searches with blows, minutes on a busy machine
def test_what_a_blow_makes_of_the_least_change_is_no_second_effect(shared: Path) -> None:
    """None of those that act as a force does, or hold y where it is: the others are left out for time."""
    case = shared / "practice_cases" / "case_005"
    able = {
        "plant.hard_stop", "plant.coulomb_friction", "plant.quadratic_drag", "plant.cubic_stiffness",
        "plant.hysteresis", "plant.resonance", "environment.step_load", "environment.gain_step", "sensor.saturation",
    }  # fmt: skip
    recordings = [read_recording(case / f"rec{k}.csv") for k in (1, 2)]
    found = diagnose(read_model(case / "model.toml"), recordings, without=[n for n in CATALOGUE if n not in able])
    assert [e.name for e in found.effects] == ["plant.hard_stop"]
    assert found.effects[0].parameters["high"].value == pytest.approx(6.8958, abs=0.01)


def test_play_of_a_real_valve_is_named(shared: Path) -> None:
    """A flow loop with stiction."""
    case = shared / "real_cases" / "p_07"
    found = diagnose(read_model(case / "model.toml"), [read_recording(case / "fit.csv")])
    assert found.effects[0].name == "actuator.backlash"


def test_a_real_swing_whose_rows_were_stamped_on_arrival_is_forecast_at_even_times(shared: Path) -> None:
    case = shared / "real_cases" / "m_18"
    found = diagnose(read_model(case / "model.toml"), [read_recording(case / "fit.csv")])
    assert found.effects[0].name == "timing.jitter"  # the joint rubs as well
    unseen = read_recording(case / "test.csv")
    scored = unseen.t >= 1.6
    error = (forecast(found.extended_model, unseen, 1.5) - unseen.y)[scored]
    # 0.25 with even times from the first stamp to the last; a linear model whose stamps were right leaves 0.097
    assert float(np.sqrt(np.mean(error**2)) / np.std(unseen.y[scored])) < 0.1
