from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.controller import Controller, DiscreteController, PIDController, read_controller, write_controller
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
        ('kind = "pi"\nK = 1.0\n', "Ti_s = None"),
        ('kind = "pi"\nK = 1.0\nTi_s = -3\n', "Ti_s = -3"),
        ('kind = "fuzzy"\n', "kind = 'fuzzy'"),
        ("num = [1.0]\n", "num and den"),
        ("num = [1.0]\nden = [0.0, 1.0]\nsample_time_s = 1.0\n", "den begin"),
        ("K = \n", "not TOML"),
    ],
)
def test_a_wrong_controller_is_refused_with_its_key(tmp_path: Path, content: str, says: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(content)
    with pytest.raises(InputError, match=says):
        read_controller(path)
