"""Whatever a plant does when it is pushed first, its sign is the sign of its gain."""

from __future__ import annotations

from pathlib import Path

import pytest

from autotune.config import load_config
from autotune.experiment.approach import approach, find_midpoint
from autotune.experiment.preflight import Known, preflight
from drivers.simulated import SimulatedRig
from sim.tank import make_two_tank
from tests.autotune.experiment.rigs import CONFIG, U_REST, ball_config, open_loop, textbook_plant


def learn_sign(folder: Path, written: str, *, time_s: float, samples: float, swing: float, u_before: float) -> Known:
    """Approach a plant that rested under another command until now, with noise of a hundredth of the swing."""
    plant = textbook_plant(written, u_start=u_before, noise=0.01 * swing)
    config = ball_config(
        signals={"sample_time_s": time_s / samples, "u_step": 0.0},
        limits={
            "u_safe": U_REST, "y_min": -200.0 * swing, "y_max": 200.0 * swing, "swing": swing, "time_s": 1000.0 * time_s
        },
        operating_point={"y": 0.0, "u_guess": U_REST, "u_uncertainty": 0.5, "approach": "hold", "plant_sign": 0},
    )  # fmt: skip
    rig = SimulatedRig(plant, u_safe=U_REST)
    with open_loop(rig, folder / "recording.csv", config) as loop:
        known = preflight(loop, config.operating_point, config.experiment.gain_sd, lambda _: None)
        return approach(loop, config.operating_point, known, lambda _: None)


@pytest.mark.parametrize(
    ("written", "time_s", "gain"),
    [
        ("2/((s+1)(0.5s+1))", 1.5, 2.0),
        ("-1/(s+1)^3", 3.0, -1.0),
        ("100/((30s+1)(10s+1)) e^-15s", 55.0, 100.0),
        ("3/(s^2+0.6s+1)", 1.0, 3.0),
    ],
)
@pytest.mark.parametrize("samples", [40.0, 400.0])
def test_a_plant_that_is_still_cooling_down_when_it_is_pushed(
    tmp_path: Path, written: str, time_s: float, gain: float, samples: float
) -> None:
    known = learn_sign(tmp_path, written, time_s=time_s, samples=samples, swing=0.625 * abs(gain), u_before=8.0)
    assert known.plant_sign * gain > 0.0


@pytest.mark.parametrize(
    ("written", "time_s", "gain"),
    [
        ("0.5/(2s+1) e^-6s", 8.0, 0.5),
        ("-4/((5s+1)(3s+1)(s+1)) e^-15s", 24.0, -4.0),
        ("0.001/s e^-60s", 60.0, 0.24),
        ("20/((4s^2+1.2s+1)(s+1)) e^-1s", 4.0, 20.0),
    ],
)
def test_a_plant_that_goes_on_after_the_command_has_turned(
    tmp_path: Path, written: str, time_s: float, gain: float
) -> None:
    """Within its dead time it moves by more than what counts as an answer, where little swing is allowed."""
    known = learn_sign(tmp_path, written, time_s=time_s, samples=40.0, swing=0.125 * abs(gain), u_before=U_REST)
    assert known.plant_sign * gain > 0.0
    assert known.midpoint == pytest.approx(U_REST, abs=0.25)


@pytest.mark.parametrize("seed", range(6))
def test_the_mid_point_is_found_of_tanks_that_the_pushes_led_away_from_the_operating_point(
    tmp_path: Path, seed: int
) -> None:
    """The pump's gain is up to a tenth off: y goes where, on its way back, more command seems to be needed."""
    config, plant = load_config(CONFIG.with_name("two_tank_sim.toml")), make_two_tank(seed=seed, start="level")
    point, said = config.operating_point, lambda _: None
    with open_loop(SimulatedRig(plant, u_safe=0.0), tmp_path / "recording.csv", config) as loop:
        known = preflight(loop, point, config.experiment.gain_sd, said)
        known, _ = find_midpoint(loop, point, None, approach(loop, point, known, said), said)
    assert known.plant_sign == 1
    assert known.midpoint == pytest.approx(plant.u_rest, abs=0.05)
