from __future__ import annotations

import math

import pytest

from autotune.config.rig import ReplaySettings, SimulatedRigSettings
from autotune.controller import PIDController
from autotune.errors import InputError, LinkError
from autotune.experiment.rig import HoldsGains, Rig
from drivers import open_rig
from drivers.kinds import Session
from drivers.simulated import SimulatedRig, open_kind
from sim.ball import make_ball
from tests.sim.imperfections import Fault, FaultyPlant, FaultyRig


def ball_rig(*faults: Fault) -> SimulatedRig:
    return FaultyRig(FaultyPlant(make_ball(seed=1), faults), u_safe=0.5)


def test_time_moves_only_when_somebody_waits() -> None:
    rig = ball_rig()
    rig.open()
    assert rig.clock.now() == 0.0
    rig.clock.sleep_until(2.0)
    assert rig.clock.now() == 2.0
    assert rig.plant.time_s == pytest.approx(2.0)
    rig.clock.sleep_until(1.0)  # has passed
    assert rig.clock.now() == 2.0


def test_who_watches_waits_a_tenth_of_the_rigs_time_at_ten_times_its_speed() -> None:
    watched = SimulatedRig(make_ball(seed=2), u_safe=0.5).clock
    rig = SimulatedRig(make_ball(seed=1), u_safe=0.5, speed=10.0, watched=watched)
    for k in range(1, 101):
        rig.clock.sleep_until(0.02 * k)
    assert rig.clock.now() == pytest.approx(2.0)
    assert rig.plant.time_s == pytest.approx(2.0)
    assert watched.now() == pytest.approx(0.2)


def test_only_a_simulated_rig_is_given_a_speed() -> None:
    recorded = ReplaySettings(kind="replay", recording="recording.csv")
    with pytest.raises(InputError, match="has its own time"):
        open_rig(recorded, u_range=(0.0, 1.0), u_safe=0.5, speed=10.0)


def test_the_plant_lives_under_the_command_it_holds() -> None:
    rig = ball_rig()
    rig.open()
    rig.write(3.0)
    rig.clock.sleep_until(0.01)
    assert rig.read().u_applied == pytest.approx(3.0, abs=10 / 4096)


def test_the_safe_output_is_held_from_every_state_and_more_than_once() -> None:
    rig = ball_rig()
    rig.make_safe()
    rig.open()
    rig.write(3.0)
    rig.make_safe()
    rig.make_safe()
    assert rig.command == 0.5
    rig.close()
    rig.close()
    rig.make_safe()
    assert rig.command == 0.5


def test_a_rig_that_is_not_open_is_not_commanded() -> None:
    with pytest.raises(LinkError, match="not open"):
        ball_rig().write(3.0)


def test_a_cut_link_is_a_link_error_never_a_sample() -> None:
    rig = ball_rig(Fault(kind="cut link", start_s=0.5))
    rig.open()
    rig.clock.sleep_until(1.0)
    with pytest.raises(LinkError):
        rig.read()
    with pytest.raises(LinkError):
        rig.write(1.0)


def test_gains_are_handed_over_and_read_back() -> None:
    delivered = PIDController(K=-0.01, Ti_s=6.0)
    settings = SimulatedRigSettings(kind="simulated", plant="ball", seed=3)
    rig = open_kind(settings, Session(u_range=(0.0, 10.0), u_safe=0.0, controller=delivered))
    assert isinstance(rig, HoldsGains)
    assert rig.read_gains() == delivered
    new = PIDController(K=-0.025, Ti_s=3.6)
    rig.write_gains(new)
    assert rig.read_gains() == new


def test_a_rig_without_a_controller_of_its_own_holds_none() -> None:
    assert ball_rig().read_gains() == PIDController(K=0.0, Ti_s=math.inf)


def test_it_is_a_rig() -> None:
    rig: Rig = ball_rig()  # the type checker reads this line
    rig.open()
    assert math.isfinite(rig.read().y)
