from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from autotune.config import Config, json_schema, load_config
from autotune.config.rig import ModbusTcpSettings
from autotune.errors import InputError

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
COMPLETE = """
name = "ball"
[rig]
kind = "simulated"
plant = "ball"
[signals]
sample_time_s = 0.01
[limits]
u_min = 0.0
u_max = 10.0
u_safe = 0.0
y_min = 1.0
y_max = 9.0
swing = 3.0
[operating_point]
y = 5.0
u_guess = 5.0
u_uncertainty = 0.5
"""


def write(tmp_path: Path, content: str) -> Path:
    path = tmp_path / "config.toml"
    path.write_text(content)
    return path


def test_what_is_left_out_has_a_default(tmp_path: Path) -> None:
    config = load_config(write(tmp_path, COMPLETE))
    assert config.experiment.points == 5
    modulus, phase = config.design.margins
    assert modulus == 0.5
    assert phase == pytest.approx(0.785398, rel=1e-6)  # Spec1: 45 deg


def test_margins_replace_those_of_the_named_specification(tmp_path: Path) -> None:
    design = '[design]\nspecification = "Spec2"\nphase_margin_deg = 50\n'
    modulus, phase = load_config(write(tmp_path, COMPLETE + design)).design.margins
    assert (modulus, phase) == (0.8, pytest.approx(0.872665, rel=1e-6))


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("swing = 3.0", "swimg = 3.0", r"unknown key 'limits\.swimg'.*did you mean 'swing'\?"),
        ("[limits]", "[limit]", r"unknown key 'limit'.*did you mean 'limits'\?"),
        ('plant = "ball"', 'plant = "bowl"', r"rig\.plant = 'bowl'.*'ball', 'servo', 'two_tank' or 'thermal'"),
        ('plant = "ball"', 'plants = "ball"', r"unknown key 'rig\.plants'.*did you mean 'plant'\?"),
        (
            "sample_time_s = 0.01",
            "sample_time_s = 0",
            r"signals\.sample_time_s = 0.*greater than or equal to 0.000001.*control period \[s\]",
        ),
        ("swing = 3.0", "", r"'limits\.swing' is missing.*\[y unit\]"),
        ("u_safe = 0.0", "u_safe = 11.0", r"u_safe = 11 must lie within u_min\.\.u_max"),
        ("y_min = 1.0", "y_min = 9.5", r"y_min = 9\.5 must be below y_max = 9"),
        ("u_max = 10.0", "u_max = nan", r"limits\.u_max = nan.*finite"),
        ("u_max = 10.0", 'u_max = "ten"', r"limits\.u_max = 'ten'.*valid number"),
        ("swing = 3.0", "swing = 1e9", r"swing = 1e\+09 is more than y_min\.\.y_max allow, 8"),
        (
            "[operating_point]",
            "[experiment]\nbudget_s = 1e-6\n[operating_point]",
            r"budget_s = 1e-06 .*100 samples of 0\.01",
        ),
        ("name = ", "name ", "not TOML"),
        ("u_max = 10.0", "u_max = 10,0", r"not TOML.*line 10.*: u_max = 10,0; write the decimal mark as a point"),
        ('plant = "ball"', "plant = ball", r"not TOML.*line 5.*: plant = ball; put texts in quotes"),
        ('plant = "ball"', 'plant = "ball', r'not TOML.*line 5.*: plant = "ball; close the quotes'),
        ("u_max = 10.0", "u_max = 10.0.", r"not TOML.*line 10.*: u_max = 10\.0\.; correct the line"),
        ('kind = "simulated"', 'kind = "simulate"', r"rig\.kind = 'simulate' is none of.*did you mean 'simulated'\?"),
        ('kind = "simulated"', 'kind = "balloon"', r"rig\.kind = 'balloon' is none of.*; how the rig is reached"),
        ('kind = "simulated"', "", r"'rig\.kind' is missing; how the rig is reached"),
    ],
)
def test_a_refused_key_is_named_with_its_path_range_and_nearest_name(
    tmp_path: Path, before: str, after: str, says: str
) -> None:
    assert before in COMPLETE
    path = write(tmp_path, COMPLETE.replace(before, after, 1))
    with pytest.raises(InputError, match=says) as caught:
        load_config(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_all_that_is_wrong_is_named_at_once_and_a_misspelt_key_is_not_missing_too(tmp_path: Path) -> None:
    wrong = COMPLETE.replace("swing", "swnig").replace("u_safe = 0.0", 'u_safe = "zero"')
    with pytest.raises(InputError, match=r"'limits\.swnig' \(also wrong: limits\.u_safe\); did you mean 'swing'\?$"):
        load_config(write(tmp_path, wrong))
    for key in ("u_min", "u_max", "y_min", "y_max"):
        wrong = wrong.replace(f"{key} = ", f"{key} = 1e99 #")
    with pytest.raises(InputError, match=r"\(also wrong: limits\.u_min, limits\.u_max, limits\.u_safe and 2 more\)"):
        load_config(write(tmp_path, wrong))


def test_every_key_of_the_schema_says_what_it_is() -> None:
    schema = json_schema()
    undescribed = [
        f"{table}.{key}"
        for table, definition in schema["$defs"].items()
        for key, entry in definition.get("properties", {}).items()
        if key != "kind" and not ({"description", "$ref"} & entry.keys() or "anyOf" in entry)
    ]
    assert undescribed == []


#: the command line, which says on stdout whether the method was imported
COMMAND = """
import atexit, sys
from autotune.cli import main
atexit.register(lambda: print("scipy" in sys.modules))
main()
"""


def test_a_refusal_on_the_command_line_is_one_line_and_status_2_before_the_method_is_imported(tmp_path: Path) -> None:
    path = write(tmp_path, COMPLETE.replace("swing", "swimg"))
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, "run", str(path), "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "False\n")
    assert done.stderr.count("\n") == 1
    assert "limits.swimg" in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_schema_command_writes_what_editors_read(tmp_path: Path) -> None:
    out = tmp_path / "schema.json"
    subprocess.run([sys.executable, "-m", "autotune.cli", "schema", "--out", str(out)], check=True, capture_output=True)
    assert json.loads(out.read_text()) == json_schema()


def _on_register(limits: dict[str, float], **register: Any) -> Config:
    given = load_config(CONFIGS / "servo_sim.toml").model_dump()
    rig = {"kind": "modbus_tcp", "registers": {"y": {"address": 0, "table": "input"}, "u": {"address": 0, **register}}}
    limits = given["limits"] | limits
    at = given["operating_point"] | {"u_guess": 0.5 * (limits["u_min"] + limits["u_max"])}
    return Config.model_validate(given | {"rig": rig, "limits": limits, "operating_point": at})


def test_limits_are_cut_inwards_to_what_the_commands_register_can_hold() -> None:
    config = _on_register({"u_min": -9.6, "u_max": 9.6, "u_safe": 0.0})
    assert (config.limits.u_min, config.limits.u_max, config.signals.u_step) == (-9.0, 9.0, 1.0)
    assert Config.model_validate(config.model_dump()) == config  # and once only
    for kept in ({"type": "float32"}, {"scale": 0.1}, {"scale": -1e-3}, {"scale": 1e-3, "offset": 2.0}):
        limits = _on_register({"u_min": -9.6, "u_max": 9.6, "u_safe": 0.0}, **kept).limits
        assert (limits.u_min, limits.u_max, limits.u_safe) == (-9.6, 9.6, 0.0)


def test_a_safe_output_that_its_register_cannot_hold_is_refused_with_what_it_can() -> None:
    for u_safe, u_min in ((0.4, -9.6), (0.4, 0.4)):
        with pytest.raises(ValueError, match=r"limits.u_safe = 0.4: .* is [01];"):
            _on_register({"u_min": u_min, "u_max": 9.6, "u_safe": u_safe})
    with pytest.raises(ValueError, match=r"limits.u_min..u_max: .*has not two values"):
        _on_register({"u_min": 0.2, "u_max": 0.9, "u_safe": 0.4})
    assert _on_register({"u_min": 0.0, "u_max": 9.6, "u_safe": 0.04}, scale=0.1).limits.u_safe == 0.0


def test_a_sample_time_below_the_programs_cycle_is_refused_with_the_reason(tmp_path: Path) -> None:
    given = (CONFIGS / "ball_modbus_tcp.toml").read_text().replace("[rig]", "[rig]\nscan_time_s = 0.02", 1)
    (tmp_path / "slow.toml").write_text(given)
    with pytest.raises(InputError, match=r"sample_time_s = 0.01 is below rig.scan_time_s = 0.02: the device's program"):
        load_config(tmp_path / "slow.toml")


def test_a_permissive_is_part_of_the_rigs_table(tmp_path: Path) -> None:
    door = '\n[[rig.permissives]]\nname = "door"\ntable = "discrete"\naddress = 3\n'
    given = (CONFIGS / "ball_modbus_tcp.toml").read_text() + door
    (tmp_path / "door.toml").write_text(given)
    rig = load_config(tmp_path / "door.toml").rig
    assert isinstance(rig, ModbusTcpSettings)
    assert [(one.name, one.type, one.holds(1.0)) for one in rig.permissives] == [("door", "bit", True)]


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ("u_guess = 5.0", "u_guess = 0.0", r"u_guess = 0 must lie between limits\.u_min and u_max"),
        ("phases_deg = [-105.0, -160.0]", "phases_deg = [-30.0, -60.0]", r"phases_deg\.0 = -30.*-91"),
        ("phases_deg = [-105.0, -160.0]", "phases_deg = [-105.0, -106.0]", "at least 5 degrees apart"),
        ("sample_time_s = 0.01", "sample_time_s = 1e-308", r"sample_time_s = 1e-308.*1e-6 up to 3600"),
        ("u_step = 0.00244140625", "u_step = 1e-308", r"u_step = 1e-308 is no step of a command between 0 and 10"),
        ("u_step = 0.00244140625", "u_step = 11.0", r"u_step = 11 is no step of a command between 0 and 10"),
        ("K = -0.01", "K = 1e300", r"controller\.K = 1e\+300"),
        ('name = "', 'name = "\\u001b[2J', "control character"),
        ('name = "', f'name = "{"x" * 300}', "at most 200 characters"),
    ],
)
def test_what_would_end_in_the_middle_of_a_run_is_refused_before_it(
    tmp_path: Path, before: str, after: str, says: str
) -> None:
    shipped = (Path(__file__).parents[2] / "configs" / "ball_sim.toml").read_text()
    assert before in shipped
    path = write(tmp_path, shipped.replace(before, after, 1))
    with pytest.raises(InputError, match=says) as refused:
        load_config(path)
    assert len(str(refused.value)) < 400
