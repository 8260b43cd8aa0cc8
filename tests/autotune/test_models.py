from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.errors import InputError
from autotune.model_tables import read_model, write_model
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction

#: Le & Mendes 2010, equation (23)
BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))

coefficients = st.lists(st.floats(0.1, 10), min_size=1, max_size=4).map(tuple)
CHAIN = """
name = "ball in tube"
[input]
unit = "V"
offset = 5.0
[output]
unit = "V"
offset = 5.0
[[block]]
name = "turbine"
place = "actuator"
num = [1.0]
den = [0.016668, 1.0]
delay = 0.02
[[block]]
name = "ball speed"
place = "plant"
num = [-65.5]
den = [0.36359, 1.0]
output = "speed"
unit = "V/s"
"""


def test_poles_of_the_ball_are_the_recomputed_ones() -> None:
    np.testing.assert_allclose(sorted(BALL.poles.real), [-300.03, -59.994, -2.7503, 0.0], rtol=2e-4, atol=1e-9)
    assert BALL.integrators == 1


def test_gain_crossover_of_the_ball_is_not_the_printed_13_5() -> None:
    assert abs(BALL.response(np.array([13.118]))[0]) == pytest.approx(1.0, rel=2e-4)  # paper: 13.5 rad/s


@pytest.mark.parametrize(("omega", "phase_deg"), [(2.4893, -135.0), (11.6817, -180.0)])
def test_phase_of_the_positive_gain_ball(omega: float, phase_deg: float) -> None:
    response = -BALL.response(np.array([omega]))[0]
    assert np.exp(1j * np.angle(response)) == pytest.approx(np.exp(1j * np.radians(phase_deg)), abs=2e-5)


@given(num=coefficients, den=coefficients, omega=st.floats(1e-3, 1e3))
def test_rational_response_agrees_with_python_control(
    num: tuple[float, ...], den: tuple[float, ...], omega: float
) -> None:
    ours = TransferFunction(num=num, den=den).response(np.array([omega]))[0]
    assert ours == pytest.approx(control.tf(list(num), list(den))(1j * omega), rel=1e-9)


@given(num=coefficients, den=coefficients, delay=st.floats(0, 20), omega=st.floats(1e-3, 1e2))
def test_dead_time_turns_the_phase_only(
    num: tuple[float, ...], den: tuple[float, ...], delay: float, omega: float
) -> None:
    w = np.array([omega])
    without = TransferFunction(num=num, den=den).response(w)[0]
    with_delay = TransferFunction(num=num, den=den, delay_s=delay).response(w)[0]
    assert abs(with_delay) == pytest.approx(abs(without), rel=1e-9)
    assert with_delay == pytest.approx(without * np.exp(-1j * omega * delay), rel=1e-9)


def test_a_chain_is_the_product_of_its_blocks(tmp_path: Path) -> None:
    path = tmp_path / "model.toml"
    path.write_text(CHAIN)
    model = read_model(path)
    omega = np.geomspace(0.01, 100, 20)
    np.testing.assert_allclose(model.response(omega), model.transfer_function().response(omega), rtol=1e-12)
    assert [block.place for block in model.blocks] == ["actuator", "plant"]
    assert model.blocks[1].output == "speed"


def test_a_written_model_reads_back_equal(tmp_path: Path) -> None:
    friction = Effect(
        name="plant.coulomb_friction", at="mass", parameters={"level": Parameter(value=0.1, unit="V", sd=0.01)}
    )
    model = Model(
        name="servo",
        input=Port(unit="V", offset=1.0, hold="linear"),
        output=Port(unit="rad", recorded=(-1.0, 2.5)),
        blocks=(Block(name="mass", place="plant", dynamics=TransferFunction(num=(2.0,), den=(1.0, 1.0), delay_s=0.1)),),
        effects=(friction,),
    )
    write_model(model, tmp_path / "m.toml", {"plant.coulomb_friction": "tau v' = K u - v - K level sign(v)"})
    assert read_model(tmp_path / "m.toml") == model


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('place = "plant"', 'place = "wall"'), "place = 'wall'"),
        (("den = [0.36359, 1.0]", "den = [0.0]"), "denominator is zero"),
        (("num = [-65.5]", "num = [1.0, 0.0, 0.0]"), "higher degree"),
        (("delay = 0.02", "delay = -0.02"), "negative"),
        (("offset = 5.0", 'offset = "five"'), "offset = 'five'"),
        (('unit = "V/s"', 'units = "V/s"'), "unknown key 'units'"),
        (('name = "ball in tube"', "den = [2.0, 1.0]"), r"den stand outside of a table; write \[\[block\]\] above"),
        (("offset = 5.0", "recorded = [1.0]"), "recorded = "),
        (("offset = 5.0", "recorded = [2.0, 1.0]"), "recorded = "),
    ],
)
def test_a_wrong_model_is_refused_with_its_table(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    path = tmp_path / "model.toml"
    path.write_text(CHAIN.replace(*change, 1))
    with pytest.raises(InputError, match=says) as caught:
        read_model(path)
    assert str(path) in str(caught.value)


@given(low=st.floats(-1e3, 1e3), span=st.floats(1e-3, 1e3), beyond=st.floats(0.0, 10.0))
def test_how_far_a_signal_leaves_the_recorded_range_is_counted_in_its_spans(
    low: float, span: float, beyond: float
) -> None:
    port = Port(recorded=(low, low + span))
    above = np.array([low, low + span, low + span * (1.0 + beyond), np.nan])
    found, share = port.beyond(above)
    assert found == pytest.approx(beyond, abs=1e-6 * (1.0 + abs(low) / span))
    assert share <= 1.0 / 3.0
    assert port.beyond(2.0 * low + span - above)[0] == pytest.approx(found, abs=1e-6 * (1.0 + abs(low) / span))


def test_parameters_of_unknown_standard_deviation_are_equal_and_one_in_a_set() -> None:
    """Whichever NaN stands for it: Python 3.13 compares fields one by one, and no NaN equals itself."""
    one, other = Parameter(value=0.2, unit="V"), Parameter(value=0.2, unit="V", sd=float("nan"))
    assert one == other
    assert len({one, other}) == 1
    assert one != Parameter(value=0.2, unit="V", sd=0.1)
    assert one != Parameter(value=0.2, unit="A")


@pytest.mark.parametrize(
    ("unit", "output", "den", "speed"),
    [
        ("rad/s", "", (0.2, 1.0), "rad/s"),
        ("V", "speed", (0.2, 1.0), "V"),
        ("mm", "position", (0.2, 1.0, 0.0), "mm/s"),
        ("", "", (0.2, 1.0, 3.0), ""),
    ],
)
def test_a_speed_that_is_read_has_the_readings_unit(unit: str, output: str, den: tuple[float, ...], speed: str) -> None:
    plant = Block(name="plant", place="plant", dynamics=TransferFunction(num=(1.0,), den=den), output=output)
    assert Model(name="rig", input=Port(unit="V"), output=Port(unit=unit), blocks=(plant,)).speed_unit == speed


@pytest.mark.parametrize(("den", "force"), [((1.0,), "kN"), ((0.2, 1.0), "V")])
def test_the_force_of_a_damper_is_what_is_read_and_that_of_a_drive_its_command(
    den: tuple[float, ...], force: str
) -> None:
    plant = Block(name="plant", place="plant", dynamics=TransferFunction(num=(1.0,), den=den))
    assert Model(name="rig", input=Port(unit="V"), output=Port(unit="kN"), blocks=(plant,)).force_unit == force
