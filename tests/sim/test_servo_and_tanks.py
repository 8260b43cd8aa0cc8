"""The simulated plants against their own physics: what they answer, where they rest, what they cannot do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.plant import Plant, make_plant
from sim.servo import Servo, ServoSettings
from sim.tank import Heater, HeaterSettings, TwoTank, TwoTankSettings

STARTS = {"servo": "rest", "two_tank": "level", "thermal": "warm"}
#: plant, probing frequencies [rad/s], sample time [s], amplitude [u unit]
PROBES = [
    ("servo", (2.0, 12.0, 60.0), 1e-3, 0.5),
    ("two_tank", (0.02, 0.05, 0.2), 0.2, 0.02),
    ("thermal", (0.01, 0.05, 0.2), 0.25, 0.5),
]


def quiet(name: str) -> Plant:
    match name:
        case "servo":
            return Servo(ServoSettings(noise=0.0, resolution=0.0, load=0.2))
        case "two_tank":
            return TwoTank(TwoTankSettings(noise=0.0, start=10.0))
        case _:
            return Heater(HeaterSettings(noise=0.0), warm=True)


@pytest.mark.parametrize(("name", "omegas", "dt_s", "amplitude"), PROBES)
def test_a_small_sine_is_answered_with_the_stated_response(
    name: str, omegas: tuple[float, ...], dt_s: float, amplitude: float
) -> None:
    for omega in omegas:
        plant = quiet(name)
        period = 2.0 * math.pi / omega
        n = max(1, round(period / dt_s))
        step = period / n
        lead_in, periods = (30 if name == "two_tank" else 8) * n, 2
        t = step * np.arange(lead_in + periods * n)
        u = amplitude * np.sin(omega * t)
        y = np.empty_like(t)
        for k in range(t.size):
            y[k] = plant.y_true
            plant.advance(plant.u_rest + u[k], step)
        late = slice(lead_in, None)
        # an integrating plant keeps an offset from the start, a slow one the end of its transient
        t_late = t[late] - t[lead_in]
        basis = np.column_stack([np.cos(omega * t_late), np.sin(omega * t_late), np.ones_like(t_late), t_late])
        (y_c, y_s, *_), (u_c, u_s, *_) = (np.linalg.lstsq(basis, x[late], rcond=None)[0] for x in (y, u))
        measured = (y_c - 1j * y_s) / (u_c - 1j * u_s)
        hold = np.exp(-0.5j * omega * step) * np.sinc(omega * step / (2.0 * math.pi))
        expected = plant.response(np.array([omega]))[0] * hold
        assert abs(measured / expected - 1.0) < 0.01


@pytest.mark.parametrize("name", STARTS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_the_resting_command_rests(name: str, seed: int) -> None:
    plant = make_plant(name, seed=seed, noise=0.0, start=STARTS[name])
    before = plant.y_true
    for _ in range(50):
        plant.advance(plant.u_rest, 1.0)
    assert plant.y_true == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("name", STARTS)
@given(data=st.data())
@settings(max_examples=20)
def test_a_held_command_may_be_held_in_pieces(name: str, data: Any) -> None:
    pieces = data.draw(st.lists(st.floats(1e-4, 0.5), min_size=1, max_size=12))
    whole, cut = quiet(name), quiet(name)
    u = whole.u_rest * 1.1 + 0.1
    whole.advance(u, sum(pieces))
    for piece in pieces:
        cut.advance(u, piece)
    assert cut.y_true == pytest.approx(whole.y_true, rel=1e-6)
    assert cut.time_s == pytest.approx(whole.time_s)


@pytest.mark.parametrize("name", STARTS)
def test_a_seed_repeats_itself_and_another_differs(name: str) -> None:
    one, same, other = (make_plant(name, seed=seed) for seed in (7, 7, 8))
    assert [one.measure() for _ in range(5)] == [same.measure() for _ in range(5)]
    assert one.u_rest == same.u_rest
    assert one.u_rest != other.u_rest


@pytest.mark.parametrize(("name", "beyond"), [("servo", 1e3), ("two_tank", 1e3), ("thermal", 1e3)])
def test_no_command_gets_beyond_the_actuators_range(name: str, beyond: float) -> None:
    plant = quiet(name)
    for u in (beyond, -beyond):
        plant.advance(u, 0.1)
        assert abs(plant.u_applied) <= 100.0
        assert plant.u_applied != u


def test_a_full_tank_runs_over_and_an_empty_one_stays_empty() -> None:
    tanks = TwoTank(TwoTankSettings(noise=0.0))
    for _ in range(600):
        tanks.advance(10.0, 1.0)
    assert tanks.y_true == pytest.approx(20.0, abs=1e-3)
    for _ in range(3000):
        tanks.advance(0.0, 1.0)
    assert tanks.y_true == pytest.approx(0.0, abs=1e-3)


def test_a_level_falls_as_torricelli_says() -> None:
    # an outlet of area a empties a tank of area A as sqrt(h) = sqrt(h0) - a/A sqrt(g/2) t; the upper tank is looked at
    tanks = TwoTank(TwoTankSettings(noise=0.0, start=15.0))
    tanks.advance(0.0, 20.0)  # the pump has run out
    h0 = tanks._x[1]
    tanks.advance(0.0, 30.0)
    expected = (math.sqrt(h0) - 0.071 / 28.0 * math.sqrt(981.0 / 2.0) * 30.0) ** 2
    assert tanks._x[1] == pytest.approx(expected, rel=1e-6)


def test_a_hot_block_loses_heat_to_radiation_as_well() -> None:
    black = Heater(HeaterSettings(noise=0.0, loss=0.0, emissivity=1.0), warm=True)
    black.advance(0.0, 1e-3)
    T, Ta = 50.0 + 273.15, 22.0 + 273.15
    # Stefan-Boltzmann; the element is still warm, so the power it was held with is still there
    assert black.u_rest / 100.0 * 10.0 == pytest.approx(5.670374419e-8 * 0.0012 * (T**4 - Ta**4))


@pytest.mark.parametrize("name", STARTS)
def test_a_start_that_does_not_exist_is_named(name: str) -> None:
    with pytest.raises(ValueError, match="upside down"):
        make_plant(name, start="upside down")
