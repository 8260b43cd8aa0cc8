from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.controller import (
    Controller,
    DiscreteController,
    PIDController,
    pid_from_table,
    read_controller,
    write_controller,
)
from autotune.errors import InputError
from autotune.models import TransferFunction

gain = st.floats(-100, 100).filter(lambda value: abs(value) > 1e-3)
seconds = st.floats(1e-3, 1e3)


@given(K=gain, Ti=seconds, Td=seconds, Tf=seconds, omega=st.floats(1e-3, 1e3))
def test_the_isa_form_is_what_the_response_says(K: float, Ti: float, Td: float, Tf: float, omega: float) -> None:
    s = 1j * omega
    response = PIDController(K=K, Ti_s=Ti, Td_s=Td, Tf_s=Tf).response(np.array([omega]))[0]
    assert response == pytest.approx(K * (1 + 1 / (Ti * s) + Td * s) / (1 + Tf * s), rel=1e-9)


@pytest.mark.parametrize(
    "controller",
    [
        PIDController(K=-0.023, Ti_s=3.0),
        PIDController(K=2.0, Ti_s=3.0, Td_s=0.1, Tf_s=0.01, setpoint_weight=0.5),
        TransferFunction(num=(1.0, 2.0), den=(1.0, 0.0)),
        DiscreteController(num=(0.63, -2.083), den=(1.0, -2.65), sample_time_s=1.0),
    ],
)
def test_a_written_controller_reads_back_equal(tmp_path: Path, controller: Controller) -> None:
    write_controller(controller, tmp_path / "c.toml")
    assert read_controller(tmp_path / "c.toml") == controller


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('kind = "pi"\nK = 1.0\n', "'Ti_s' is missing"),
        ('kind = "pi"\nK = 1.0\nTi_s = -3\n', "Ti_s = -3"),
        ('kind = "fuzzy"\n', "kind = 'fuzzy'"),
        ("num = [1.0]\n", "'den' is missing"),
        ("num = [1.0]\nden = [0.0, 1.0]\nsample_time_s = 1.0\n", "den must begin"),
        ("K = \n", "not TOML"),
        ('kind = "pi"\nK = inf\nTi_s = 1.0\n', "K = inf"),
        ('kind = "pi"\nK = nan\nTi_s = 1.0\n', "K = nan"),
        ('kind = "pi"\nK = 0.0\nTi_s = 1.0\n', "commands nothing"),
        ('kind = "pi"\nK = 1e-300\nTi_s = 1.0\n', "commands nothing"),
        ('kind = "pi"\nK = "1"\nTi_s = 1.0\n', "K = '1'"),
        ('kind = "pi"\nK = true\nTi_s = 1.0\n', "K = True"),
        ('kind = "pi"\nK = 1.0\nTi_s = 1e-308\n', "Ti_s = 1e-308"),
        ('kind = "pi"\nK = 1.0\nTi_s = 1.0\nTd = 0.5\n', "unknown key 'Td'; did you mean 'Td_s'"),
        ('kind = "pi"\nK = 1.0\nTi_s = 1.0\nTd_s = 0.5\n', "neither Td_s nor Tf_s"),
        ("num = [true]\nden = [1.0]\n", r"num\.0 = True"),
        ('num = [1.0]\nden = ["1"]\n', r"den\.0 = '1'"),
        ("num = [0.0]\nden = [1.0]\n", "num is zero"),
    ],
)
def test_a_wrong_controller_is_refused_with_its_key(tmp_path: Path, content: str, says: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(content)
    with pytest.raises(InputError, match=says):
        read_controller(path)


@pytest.mark.parametrize(
    "table",
    [
        {"K": None, "Ti_s": 1.0}, {"K": "", "Ti_s": 1.0}, {"K": [], "Ti_s": 1.0}, {"K": math.nan, "Ti_s": 1.0},
        {"K": math.inf, "Ti_s": 1.0}, {"K": True, "Ti_s": 1.0}, {"K": 0.0, "Ti_s": 1.0}, {"K": 1.0, "Ti_s": 0},
        {"K": 1.0, "Ti_s": -1}, {"K": 1.0, "Ti_s": []}, {"K": 1.0, "Ti_s": ""}, {"K": 1.0}, {"Ti_s": 1.0}, {}, [], 5,
        {"K": 1.0, "Ti_s": 1.0, "Td": 0.1}, {"K": 1.0, "Ti_s": 1.0, "Td_s": -0.1}, {"K": 1e300, "Ti_s": 1.0},
    ],
)  # fmt: skip
def test_no_design_that_is_none_reaches_a_rig(table: object) -> None:
    with pytest.raises(InputError, match=r"^design\.json"):
        pid_from_table(table, "design.json")


def test_a_design_of_this_tool_is_read_with_what_stands_beside_its_gains() -> None:
    table = {"kind": "pi", "K": -0.02, "Ti_s": 3, "Td_s": 0.0, "Tf_s": 0.0, "h2": 0.1, "binding": [], "margins": {}}
    assert pid_from_table(table, "design.json") == PIDController(K=-0.02, Ti_s=3.0)
    assert pid_from_table({"K": 1.0, "Ti_s": None}, "design.json").Ti_s == math.inf


@pytest.mark.parametrize("name", ["design.json", "result.json", "loop.json", "folder"])
def test_the_controller_of_every_kind_of_result_is_read(tmp_path: Path, name: str) -> None:
    design = {"kind": "pi", "K": -0.02, "Ti_s": 3, "h2": 0.1, "is_integral": True}
    whole = {"points": [], "controller": design, "margins": {"modulus": 0.5}}
    content = {"design.json": design, "loop.json": {"row": {"name": "a"}, "result": whole}}.get(name, whole)
    path = tmp_path / ("result.json" if name == "folder" else name)
    path.write_text(json.dumps(content))
    assert read_controller(tmp_path if name == "folder" else path) == PIDController(K=-0.02, Ti_s=3.0)


def test_a_result_without_a_controller_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text(json.dumps({"points": [], "controller": None}))
    with pytest.raises(InputError, match="holds no K and Ti_s"):
        read_controller(path)
