"""The function blocks in Structured Text, interpreted and compiled: their laws are those in Python and in C."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blark.parse import parse_source_code

from autotune.arrays import FloatArray
from autotune.config.registers import RegisterMap
from autotune.controller import PIDController
from autotune.design.codegen import structured_text
from autotune.design.law import PILaw
from autotune.experiment.relay import RelaySettings
from tests.drivers.iec_compiler import Blocks, CompiledInstance, generated_c
from tests.drivers.laws import LAWS, RELAYS, longest_pending, measurements, pi_outputs, relay_outputs
from tests.drivers.operated_plc import FILES
from tests.drivers.structured_text import Instance, function_blocks

FOLDER = Path(__file__).parents[2] / "drivers" / "firmware" / "structured_text"


NAN = float("nan")

#: Makes an instance of a block by its name.
Make = Callable[[str], Any]


@pytest.fixture(scope="module")
def blocks() -> dict[str, Any]:
    return function_blocks(FOLDER / name for name in FILES)


@pytest.fixture(params=["interpreted", pytest.param("compiled", marks=pytest.mark.system("gcc"))])
def make(request: pytest.FixtureRequest, blocks: dict[str, Any]) -> Make:
    if request.param == "interpreted":
        return lambda name: Instance(name, blocks)
    compiled: Blocks = request.getfixturevalue("rig_blocks")
    return lambda name: CompiledInstance(name, compiled)


def relay_inputs(settings: RelaySettings) -> dict[str, Any]:
    return {
        "Y_CENTRE": settings.y_centre,
        "MIDPOINT": settings.midpoint,
        "AMPLITUDE": settings.amplitude,
        "HALF_WIDTH": settings.hysteresis,
        "DELAY_CYCLES": float(settings.delay_samples),
        "SMOOTHING": settings.smoothing,
        "PLANT_SIGN": settings.plant_sign,
    }


def test_every_file_parses_and_is_named_in_the_readme(blocks: dict[str, Any]) -> None:
    readme = (FOLDER / "README.md").read_text()
    assert set(blocks) == {"RELAY_DELAY", "PI_LAW", "RIG", "OPERATED_RIG"}
    for name in (*blocks, *(path.name for path in FOLDER.glob("*.st"))):
        assert f"`{name}`" in readme
    source, configuration = (FOLDER / "program.st").read_text().split("CONFIGURATION", 1)
    (program,) = parse_source_code(source).transform().items
    assert str(program.name) == "TUNED_RIG"
    assert "TUNED_RIG" in configuration  # the parser knows no configurations


def documented_map() -> dict[str, Any]:
    """Return the register map of the README."""
    toml = (FOLDER / "README.md").read_text().split("```toml\n")[1].split("```")[0]
    registers: dict[str, Any] = tomllib.loads(toml)["rig"]["registers"]
    return registers


def test_the_register_layout_is_one_that_a_configuration_takes_and_the_program_has() -> None:
    registers = RegisterMap.model_validate(documented_map()).mapped()
    located = dict(re.findall(r"(\w+) AT %M([WD]\d+)", (FOLDER / "program.st").read_text()))
    names = {"safe": "U_SAFE"}
    assert {names.get(name, name.upper()) for name in registers} == set(located)
    for name, register in registers.items():
        place = located[names.get(name, name.upper())]
        wide = place[0] == "D"
        assert register.address == (2048 + 2 * int(place[1:]) if wide else 1024 + int(place[1:]))
        assert register.type == ("float32" if wide else "uint16")


@pytest.mark.parametrize("settings", RELAYS, ids=str)
def test_the_relay_is_the_relay_in_python(make: Make, settings: RelaySettings) -> None:
    y = next(y for seed in range(9) if longest_pending(settings, y := measurements(seed, 900)) <= 8)
    block = make("RELAY_DELAY")
    block(RUN=False, **relay_inputs(settings))
    block.value["RUN"] = True
    u = np.array([block(Y=float(value)).value["U"] for value in y])
    assert not block.value["OVERRUN"]
    np.testing.assert_array_equal(u, relay_outputs(settings, y))


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_the_pi_is_the_pi_in_python(make: Make, law: PILaw) -> None:
    y: FloatArray = measurements(1, 900)
    c, T_s = law.controller, law.sample_time_s
    block = make("PI_LAW")
    fixed = {"K": c.K, "TI": c.Ti_s if np.isfinite(c.Ti_s) else 0.0, "CYCLE": T_s, "U_MIN": law.u_min}
    block(HOLD=True, SET_POINT=500.0, Y=float(y[0]), U_HELD=7777.0, U_MAX=law.u_max, RATE=law.u_rate * T_s, **fixed)
    block.value["HOLD"] = False
    u = np.array([block(Y=float(value)).value["U"] for value in y])
    np.testing.assert_allclose(u, pi_outputs(law, y, 500.0, 7777.0), rtol=1e-12)


def test_settings_that_make_no_sense_hold_the_midpoint(make: Make) -> None:
    good = relay_inputs(RELAYS[2])
    wrongs: list[dict[str, Any]] = [{"SMOOTHING": 0}, {"SMOOTHING": 33}, {"DELAY_CYCLES": -1.0}, {"AMPLITUDE": 0.0}]
    wrongs += [{"PLANT_SIGN": 0}]
    wrongs += [{name: NAN} for name in ("DELAY_CYCLES", "AMPLITUDE", "HALF_WIDTH", "Y_CENTRE")]
    for wrong in wrongs:
        block = make("RELAY_DELAY")
        block(RUN=False, **(good | wrong))
        assert block.value["OVERRUN"]
        assert block(RUN=True, Y=0.0).value["U"] == good["MIDPOINT"]


@pytest.fixture
def rig(make: Make) -> Any:
    inputs = {"U_SAFE": 1.0, "U_MIN": 0.0, "U_MAX": 10.0, "Y_MIN": 1.0, "Y_MAX": 9.0, "K": -0.5, "TI": 2.0}
    relay = {"MIDPOINT": 5.0, "AMPLITUDE": 1.0, "HALF_WIDTH": 0.1, "DELAY_CYCLES": 3.0, "PLANT_SIGN": -1}
    return make("RIG")(Y=5.0, SETPOINT=5.0, **inputs, **relay)


def test_the_host_commands_within_the_limits_while_its_heart_beats(rig: Any) -> None:
    assert (rig.value["U"], rig.value["MODE"]) == (1.0, 0)
    for beat, (u, allowed) in enumerate([(4.0, 4.0), (11.0, 10.0), (-3.0, 0.0)]):
        rig(ENABLE=True, U_HOST=u, HEARTBEAT=beat)
        assert (rig.value["U"], rig.value["IN_COMMAND"]) == (allowed, 1)
    rig(U_HOST=4.0, HEARTBEAT=100)
    outputs = [rig().value["U"] for _ in range(60)]
    assert outputs == [4.0] * 49 + [1.0] * 11
    rig(HEARTBEAT=101)  # coming back to life is not enough
    assert (rig.value["U"], rig.value["IN_COMMAND"], rig.value["TRIPPED"]) == (1.0, 0, True)
    rig(ENABLE=False)
    assert not rig.value["TRIPPED"]
    assert rig(ENABLE=True).value["IN_COMMAND"] == 1


def test_a_host_that_takes_over_from_the_pi_has_its_whole_time_to_beat(rig: Any) -> None:
    rig(AUTOMATIC=True)
    for _ in range(100):
        rig()
    rig(ENABLE=True, U_HOST=4.0)
    assert [rig().value["IN_COMMAND"] for _ in range(60)] == [1] * 49 + [0] * 11


@pytest.mark.parametrize(("asked", "held"), [(12.0, 10.0), (-3.0, 0.0), (NAN, 1.0), (float("inf"), 1.0)])
def test_the_safe_output_is_limited_too(rig: Any, asked: float, held: float) -> None:
    """A program that scales 12 V to an INT channel of 10 V would let it wrap to -26216 counts."""
    assert rig(U_SAFE=asked).value["U"] == held


def test_a_command_that_is_no_number_is_not_obeyed(rig: Any) -> None:
    rig(ENABLE=True, U_HOST=4.0, HEARTBEAT=1)
    for beat, wrong in enumerate((NAN, float("inf"), -float("inf")), 2):
        assert rig(U_HOST=wrong, HEARTBEAT=beat).value["U"] == 4.0
    assert rig(U_HOST=6.0, HEARTBEAT=9).value["U"] == 6.0


def test_no_mode_moves_the_output_faster_than_its_rate_but_safety(rig: Any) -> None:
    rig(ENABLE=True, U_HOST=9.0, HEARTBEAT=1, RATE=0.5)
    assert rig.value["U"] == 1.5
    assert [rig(HEARTBEAT=beat).value["U"] for beat in range(2, 5)] == [2.0, 2.5, 3.0]
    rig(RELAY_ON=True)  # its first level is 4 or 6
    assert rig.value["U"] == 3.5
    rig(RELAY_ON=False, ENABLE=False, AUTOMATIC=True)
    before = rig.value["U"]
    assert abs(rig(Y=9.0, K=-5.0).value["U"] - before) == pytest.approx(0.5)
    assert rig(AUTOMATIC=False).value["U"] == 1.0


def test_the_relay_ends_at_a_limit_on_y(rig: Any) -> None:
    rig(ENABLE=True, RELAY_ON=True, HEARTBEAT=1)
    assert rig(Y=6.0).value["U"] in (4.0, 6.0)
    assert rig(Y=9.5).value["U"] == 1.0
    assert rig(Y=5.0).value["MODE"] == 0


def test_a_measurement_that_is_no_number_ends_the_relay(rig: Any) -> None:
    rig(ENABLE=True, RELAY_ON=True, HEARTBEAT=1)
    assert rig(Y=NAN).value["MODE"] == 0


def test_the_pi_takes_over_without_a_bump_and_needs_no_host(rig: Any) -> None:
    rig(ENABLE=True, U_HOST=6.0, HEARTBEAT=1)
    rig(ENABLE=False, AUTOMATIC=True)
    assert rig.value["U"] == pytest.approx(6.0)
    assert [rig().value["MODE"] for _ in range(200)] == [3] * 200
    assert rig(Y=5.5).value["U"] == pytest.approx(6.25, abs=0.01)


def test_the_pi_on_trial_ends_with_its_host(rig: Any) -> None:
    rig(ENABLE=True, U_HOST=6.0, HEARTBEAT=1)
    rig(AUTOMATIC=True, TRIAL=True)
    rig(ENABLE=False, HEARTBEAT=2)
    assert [rig(HEARTBEAT=beat).value["MODE"] for beat in range(3, 100)] == [3] * 97
    assert [rig().value["MODE"] for _ in range(60)] == [3] * 49 + [0] * 11
    assert (rig.value["U"], rig.value["TRIPPED"]) == (1.0, True)
    rig(HEARTBEAT=101)  # coming back to life is not enough
    assert rig.value["U"] == 1.0
    rig(AUTOMATIC=False)
    assert not rig.value["TRIPPED"]
    assert [rig(AUTOMATIC=True).value["MODE"] for _ in range(60)] == [3] * 50 + [0] * 10  # by hand: these gains still
    rig(AUTOMATIC=False, TRIAL=False)
    assert [rig(AUTOMATIC=True).value["MODE"] for _ in range(60)] == [3] * 60


@pytest.mark.parametrize(
    "wrong", [{"K": NAN}, {"TI": NAN}, {"K": float("inf")}, {"Y": NAN}, {"SETPOINT": NAN}], ids=str
)
def test_gains_or_measurements_that_are_no_numbers_leave_the_pi_unharmed(rig: Any, wrong: dict[str, float]) -> None:
    rig(ENABLE=True, U_HOST=6.0, HEARTBEAT=1)
    rig(ENABLE=False, AUTOMATIC=True)
    good = {name: rig.value[name] for name in wrong}
    assert rig(**wrong).value["U"] == pytest.approx(6.0)
    assert rig(**good).value["U"] == pytest.approx(6.0)  # and no bump
    assert rig(Y=5.5).value["U"] == pytest.approx(6.25, abs=0.01)
    for _ in range(50):  # as long as the dead-man: nobody controls the plant
        rig(**{"Y": 5.0} | wrong)
    assert rig.value["U"] == 1.0
    rig(**{"Y": 5.0} | good)
    assert rig().value["U"] == pytest.approx(1.0)
    assert rig().value["MODE"] == 3


@pytest.mark.system("gcc")
def test_the_whole_program_and_the_law_that_is_written_for_a_plc_compile(tmp_path: Path) -> None:
    program = "".join((FOLDER / name).read_text() for name in (*FILES, "program.st"))
    generated_c(program, tmp_path / "program")
    assert "TUNED_RIG_body__" in (tmp_path / "program" / "POUS.c").read_text()
    page = (Path(__file__).parents[2] / "docs" / "plc.md").read_text().split("```st\n")[1].split("```")[0]
    generated_c("".join((FOLDER / name).read_text() for name in FILES) + page, tmp_path / "page")
    assert "OPERATED_body__" in (tmp_path / "page" / "POUS.c").read_text()
    for law in LAWS:
        generated_c(structured_text(law), tmp_path / "law")


@pytest.mark.system("gcc")
@pytest.mark.parametrize(
    "controller",
    [PIDController(K=-0.5, Ti_s=2.0), PIDController(K=3.0, Ti_s=0.5, Td_s=0.05, Tf_s=0.02, setpoint_weight=0.7)],
    ids=lambda c: str(c.kind),
)
def test_the_law_that_is_written_for_a_plc_is_the_law_in_python(controller: PIDController, tmp_path: Path) -> None:
    law = PILaw(controller=controller, sample_time_s=0.01, u_min=1000.0, u_max=15000.0, u_rate=3e4)
    block = CompiledInstance("CONTROL_LAW", Blocks(structured_text(law), tmp_path))
    y: FloatArray = measurements(2, 900)
    block(HOLD=True, R=500.0, Y=float(y[0]), U_HELD=7777.0)
    block.value["HOLD"] = False
    u = np.array([block(Y=float(value)).value["U"] for value in y])
    np.testing.assert_allclose(u, pi_outputs(law, y, 500.0, 7777.0), rtol=1e-12)
