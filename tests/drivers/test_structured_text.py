"""The function blocks in Structured Text: they parse, and their laws are those in Python and in C."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blark.parse import parse_source_code

from autotune.arrays import FloatArray
from autotune.config.registers import RegisterMap
from autotune.design.law import PILaw
from autotune.experiment.relay import RelaySettings
from tests.drivers.laws import LAWS, RELAYS, longest_pending, measurements, pi_outputs, relay_outputs
from tests.drivers.structured_text import Instance, function_blocks

FOLDER = Path(__file__).parents[2] / "drivers" / "firmware" / "structured_text"


@pytest.fixture(scope="module")
def blocks() -> dict[str, Any]:
    return function_blocks(FOLDER / name for name in ("relay.st", "pi.st", "rig.st"))


def relay_inputs(settings: RelaySettings) -> dict[str, Any]:
    return {
        "Y_CENTRE": settings.y_centre,
        "MIDPOINT": settings.midpoint,
        "AMPLITUDE": settings.amplitude,
        "HYSTERESIS": settings.hysteresis,
        "DELAY_CYCLES": float(settings.delay_samples),
        "SMOOTHING": settings.smoothing,
        "PLANT_SIGN": settings.plant_sign,
    }


def test_every_file_parses_and_is_named_in_the_readme(blocks: dict[str, Any]) -> None:
    readme = (FOLDER / "README.md").read_text()
    assert set(blocks) == {"RELAY_DELAY", "PI_LAW", "RIG"}
    for name in (*blocks, *(path.name for path in FOLDER.glob("*.st"))):
        assert f"`{name}`" in readme
    source, configuration = (FOLDER / "program.st").read_text().split("CONFIGURATION", 1)
    (program,) = parse_source_code(source).transform().items
    assert str(program.name) == "TUNED_RIG"
    assert "TUNED_RIG" in configuration  # the parser knows no configurations


def test_the_register_layout_is_one_that_a_configuration_takes_and_the_program_has() -> None:
    toml = (FOLDER / "README.md").read_text().split("```toml\n")[1].split("```")[0]
    registers = RegisterMap.model_validate(tomllib.loads(toml)["rig"]["registers"]).mapped()
    located = dict(re.findall(r"(\w+) AT %M([WD]\d+)", (FOLDER / "program.st").read_text()))
    names = {"safe": "U_SAFE"}
    assert {names.get(name, name.upper()) for name in registers} == set(located)
    for name, register in registers.items():
        place = located[names.get(name, name.upper())]
        wide = place[0] == "D"
        assert register.address == (2048 + 2 * int(place[1:]) if wide else 1024 + int(place[1:]))
        assert register.type == ("float32" if wide else "uint16")


@pytest.mark.parametrize("settings", RELAYS, ids=str)
def test_the_relay_is_the_relay_in_python(blocks: dict[str, Any], settings: RelaySettings) -> None:
    y = next(y for seed in range(9) if longest_pending(settings, y := measurements(seed, 900)) <= 8)
    block = Instance("RELAY_DELAY", blocks)
    block(RUN=False, **relay_inputs(settings))
    block.value["RUN"] = True
    u = np.array([block(Y=float(value)).value["U"] for value in y])
    assert not block.value["OVERRUN"]
    np.testing.assert_array_equal(u, relay_outputs(settings, y))


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_the_pi_is_the_pi_in_python(blocks: dict[str, Any], law: PILaw) -> None:
    y: FloatArray = measurements(1, 900)
    c, T_s = law.controller, law.sample_time_s
    block = Instance("PI_LAW", blocks)
    fixed = {"K": c.K, "TI": c.Ti_s if np.isfinite(c.Ti_s) else 0.0, "CYCLE": T_s, "U_MIN": law.u_min}
    block(HOLD=True, SET_POINT=500.0, Y=float(y[0]), U_HELD=7777.0, U_MAX=law.u_max, RATE=law.u_rate * T_s, **fixed)
    block.value["HOLD"] = False
    u = np.array([block(Y=float(value)).value["U"] for value in y])
    np.testing.assert_allclose(u, pi_outputs(law, y, 500.0, 7777.0), rtol=1e-12)


def test_settings_that_make_no_sense_hold_the_midpoint(blocks: dict[str, Any]) -> None:
    good = relay_inputs(RELAYS[2])
    for wrong in ({"SMOOTHING": 0}, {"SMOOTHING": 33}, {"DELAY_CYCLES": -1.0}, {"AMPLITUDE": 0.0}):
        block = Instance("RELAY_DELAY", blocks)
        block(RUN=False, **(good | wrong))
        assert block.value["OVERRUN"]
        assert block(RUN=True, Y=0.0).value["U"] == good["MIDPOINT"]


@pytest.fixture
def rig(blocks: dict[str, Any]) -> Instance:
    rig = Instance("RIG", blocks)
    inputs = {"U_SAFE": -1.0, "U_MIN": 0.0, "U_MAX": 10.0, "Y_MIN": 1.0, "Y_MAX": 9.0, "K": -0.5, "TI": 2.0}
    relay = {"MIDPOINT": 5.0, "AMPLITUDE": 1.0, "HYSTERESIS": 0.1, "DELAY_CYCLES": 3.0, "PLANT_SIGN": -1}
    return rig(Y=5.0, SETPOINT=5.0, **inputs, **relay)


def test_the_host_commands_within_the_limits_while_its_heart_beats(rig: Instance) -> None:
    assert (rig.value["U"], rig.value["MODE"]) == (-1.0, 0)
    for beat, (u, allowed) in enumerate([(4.0, 4.0), (11.0, 10.0), (-3.0, 0.0)]):
        rig(ENABLE=True, U_HOST=u, HEARTBEAT=beat)
        assert (rig.value["U"], rig.value["IN_COMMAND"]) == (allowed, 1)
    rig(U_HOST=4.0, HEARTBEAT=100)
    outputs = [rig().value["U"] for _ in range(60)]
    assert outputs == [4.0] * 49 + [-1.0] * 11
    rig(HEARTBEAT=101)  # coming back to life is not enough
    assert (rig.value["U"], rig.value["IN_COMMAND"]) == (-1.0, 0)
    rig(ENABLE=False)
    assert rig(ENABLE=True).value["IN_COMMAND"] == 1


def test_the_relay_ends_at_a_limit_on_y(rig: Instance) -> None:
    rig(ENABLE=True, RELAY_ON=True, HEARTBEAT=1)
    assert rig(Y=6.0).value["U"] in (4.0, 6.0)
    assert rig(Y=9.5).value["U"] == -1.0
    assert rig(Y=5.0).value["MODE"] == 0


def test_the_pi_takes_over_without_a_bump_and_needs_no_host(rig: Instance) -> None:
    rig(ENABLE=True, U_HOST=6.0, HEARTBEAT=1)
    rig(ENABLE=False, AUTOMATIC=True)
    assert rig.value["U"] == pytest.approx(6.0)
    assert [rig().value["MODE"] for _ in range(200)] == [3] * 200
    assert rig(Y=5.5).value["U"] == pytest.approx(6.25, abs=0.01)
