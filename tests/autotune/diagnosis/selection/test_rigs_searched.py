"""Rigs whose models are wrong by more than noise: what is named there, and what is not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis import diagnose
from autotune.diagnosis.agreement import NAMED
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.selection.judged_chain import JudgedChain, at_both_scales
from autotune.diagnosis.selection.prediction import extend
from autotune.diagnosis.simulation.chain import build_chain
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import ALL, related_effects
from autotune.effects.rigs import rig_kind
from autotune.model_tables import read_model
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording, read_recording
from sim.conceal.cases import write as write_case


def swing(gravity: float, friction: float, damping: float, *, seconds: float = 20.0, start: float = 1.6) -> Recording:
    """A free swing theta'' = -g sin(theta) - c theta' - f sign(theta'), by Runge and Kutta with fine steps."""

    def rate(state):
        angle, speed = state
        return np.array([speed, -gravity * math.sin(angle) - damping * speed - friction * math.tanh(speed / 1e-3)])

    dt, pieces = 0.01, 10
    h, state = dt / pieces, np.array([start, 0.0])
    y = np.empty(int(seconds / dt))
    for k in range(y.size):
        y[k] = state[0]
        for _ in range(pieces):
            a = rate(state)
            b = rate(state + 0.5 * h * a)
            c = rate(state + 0.5 * h * b)
            d = rate(state + h * c)
            state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    noise = 5e-4 * np.random.default_rng(3).normal(size=y.size)
    return Recording(t=dt * np.arange(y.size), u=np.zeros(y.size), y=y + noise)


def pendulum(stiffness: float, damping: float) -> Model:
    dynamics = TransferFunction(num=(1.0,), den=(1.0, damping, stiffness))
    block = Block(name="arm", place="plant", dynamics=dynamics, output="angle", unit="rad")
    return Model(name="pendulum", input=Port(), output=Port(unit="rad"), blocks=(block,))


def good(recording: Recording):
    return [np.ones(len(recording), dtype=bool)]


@pytest.fixture(scope="module")
def rubbing():
    """Return a swing with gravity and dry friction, and what a search finds in it."""
    recording = swing(gravity=22.0, friction=0.25, damping=0.02)
    return recording, search_chain(pendulum(20.0, 0.1), [recording], good(recording))


def test_gravity_and_dry_friction_of_a_pendulum_are_both_named_from_one_free_swing(rubbing):
    _, found = rubbing
    assert set(found.chosen.names) >= {"plant.sine_torque", "plant.coulomb_friction"}
    assert found.chosen.error < 0.05 * found.retuned.error


def test_the_extended_model_has_what_is_named_and_nothing_else():
    recording = swing(gravity=22.0, friction=0.25, damping=0.02)
    found = diagnose(pendulum(20.0, 0.1), [recording])
    assert found.effects
    assert {e.name for e in found.extended_model.effects} <= {e.name for e in found.effects}
    assert all(e.probability >= NAMED for e in found.effects)


def test_dry_friction_that_drops_with_speed_is_not_added_beside_plain_dry_friction():
    laws = {"plant.coulomb_friction", "plant.stribeck_friction"}
    for law in laws:
        assert related_effects([law, "actuator.lag"]) >= {*laws, "actuator.lag"}
    assert "plant.hysteresis" in related_effects(["plant.coulomb_friction"])  # dry friction where its width is 0


def test_a_linear_oscillation_is_given_no_effect():
    rng = np.random.default_rng(5)
    t = 0.01 * np.arange(1500)
    y = 0.5 * np.exp(-0.15 * t) * np.cos(4.7 * t) + 0.01 * rng.normal(size=t.size)
    recording = Recording(t=t, u=np.zeros(t.size), y=y)
    found = search_chain(pendulum(21.0, 0.25), [recording], good(recording))
    assert found.chosen.names == ()


@pytest.mark.parametrize(
    ("unit", "den", "output", "kind"),
    [
        ("rad", (1.0, 0.2, 20.0), "angle", "arm"),
        ("degC", (300.0, 1.0), "temperature", "thermal"),
        ("degC", (27.0, 36.75, 1.0), "temperature", "thermal"),
        ("m/s", (1.0, 2.0), "speed", "speed"),
        ("cm", (60.0, 1.0), "level", "level"),
        ("cm", (600.0, 70.0, 1.0), "level", "level"),
        ("V", (1.0, 40.0, 190000.0), "voltage", "oscillator"),
        ("", (5.0, 1.0), "", "process"),
    ],
)
def test_a_model_says_what_kind_of_rig_it_is(unit, den, output, kind):
    block = Block(name="plant", place="plant", dynamics=TransferFunction(num=(1.0,), den=den), output=output, unit=unit)
    model = Model(name="rig", input=Port(), output=Port(unit=unit), blocks=(block,))
    assert rig_kind(model, build_chain(model)) == kind


def test_a_long_record_of_what_swings_is_searched_in_windows_that_differ_from_scale_to_scale():
    """More rows than are fitted: those that stay are others in long windows than in short ones."""
    rng, dt, n = np.random.default_rng(4), 0.002, 22000
    u = np.repeat(rng.normal(size=n // 10), 10)
    y, (position, speed) = np.empty(n), (0.0, 0.0)
    for k in range(n):
        y[k] = position
        for _ in range(4):
            speed += dt / 4 * (400.0 * (u[k] - position - 0.4 * position**3) - 6.0 * speed)
            position += dt / 4 * speed
    recording = Recording(t=dt * np.arange(n), u=u, y=y + 0.02 * rng.normal(size=n))
    block = Block(name="plant", place="plant", dynamics=TransferFunction(num=(400.0,), den=(1.0, 6.0, 400.0)))
    model = Model(name="oscillator", input=Port(), output=Port(), blocks=(block,))
    names = [k.name for k in ALL if k.name != "plant.cubic_stiffness"]
    found = search_chain(model, [recording], good(recording), left_out=names)
    assert found.chosen.names == ("plant.cubic_stiffness",)


def test_dry_friction_may_be_missing_where_a_speed_is_measured_and_not_where_a_level_is():
    friction = next(kind for kind in ALL if kind.name == "plant.coulomb_friction")
    for output, may in (("speed", True), ("level", False)):
        block = Block(name="x", place="plant", dynamics=TransferFunction(num=(1.0,), den=(2.0, 1.0)), output=output)
        model = Model(name="rig", input=Port(), output=Port(), blocks=(block,))
        assert friction.suits.holds(build_chain(model)) is may


def test_a_gain_that_swings_is_told_where_the_lag_beside_it_is_the_lesser_part():
    """A gain that swings in time is in no catalogue; the lag of the sensor beside it is real, and the lesser part."""
    rng = np.random.default_rng(8)
    dt, t = 0.02, 0.02 * np.arange(3000)
    u = np.repeat(rng.normal(size=120), 25)
    y, state, read = np.empty(t.size), 0.0, 0.0
    for k in range(t.size):
        y[k] = read
        drive = 2.0 * (1.0 + 0.5 * math.sin(2.0 * math.pi * t[k] / 9.0)) * u[k]
        read = state + (read - state) * math.exp(-dt / 0.04)
        state = drive + (state - drive) * math.exp(-dt / 0.4)
    recording = Recording(t=t, u=u, y=y + 0.02 * rng.normal(size=t.size))
    block = Block(name="drive", place="plant", dynamics=TransferFunction(num=(2.0,), den=(0.4, 1.0)), output="speed")
    model = Model(name="drive", input=Port(), output=Port(), blocks=(block,))
    told = diagnose(model, [recording], without=[k.name for k in ALL if k.name != "sensor.lag"])
    assert told.verdict == "unexplained"
    assert any("swings with a period of about 8." in one for one in told.sentences)


def test_what_stands_for_something_else_once_it_is_fitted_to_the_end_is_not_judged():
    """Three lags warm up where the model has one: a mode whose damping ends above 1 is no resonance."""
    t = np.arange(800.0)
    taus = 170.0, 70.0, 19.0
    y = np.zeros(t.size)
    for k, tau in enumerate(taus):
        others = np.prod([tau - other for j, other in enumerate(taus) if j != k])
        y += tau**2 / others * (1.0 - np.exp(-t / tau))
    y = 20.9 + 35.0 * y + 0.15 * np.random.default_rng(4).normal(size=t.size)
    dynamics = TransferFunction(num=(0.7,), den=(170.0, 1.0))
    heater = Block(name="heater", place="plant", dynamics=dynamics, output="temperature", unit="degC")
    port = Port(unit="degC", offset=20.9)
    model = Model(name="oven", input=Port(unit="%"), output=port, blocks=(heater,))
    recording = Recording(t=t, u=np.full(t.size, 50.0), y=y)
    data, start = prepare(model, [recording], good(recording), IN_USE)
    values = {"frequency": Parameter(value=0.0044), "damping": Parameter(value=1.1)}
    p, theta, states = extend(start, Effect(name="plant.resonance", parameters=values), data)
    known = fit(p, data, theta, states)
    assert known.model.effects[0].parameters["damping"].value > 1.0
    stand_in = JudgedChain(
        names=("plant.resonance",), fit=known, short=known, data=data, few=data, long_squares=np.ones(8),
        short_squares=np.ones(8), log_odds=0.0,
    )  # fmt: skip
    found = search_chain(model, [recording], good(recording))
    again = search_chain(model, [recording], good(recording), known=[*found.judged[1:], stand_in])
    # those in which an effect came to do nothing are not judged again either
    assert {one.identity for one in again.judged} <= {one.identity for one in found.judged}
    assert found.chosen.identity in {one.identity for one in again.judged}
    # another start of it may end in a bad fit that rings: that is judged, and far behind
    every = [*found.judged, *again.judged]
    rings = [e.values["damping"] for one in every for e in one.added if e.name == "plant.resonance"]
    assert all(damping < 1.0 for damping in rings), rings
    assert set(found.chosen.names) == {"actuator.lag", "sensor.lag"}
    lags = {e.name: e.parameters["time_constant"].value for e in found.chosen.fit.model.effects}
    assert sorted(lags.values()) == pytest.approx([19.0, 70.0], rel=0.1)


def test_what_predicted_best_on_more_rows_is_judged_on_fewer_with_its_odds(rubbing):
    recording, whole = rubbing[0], rubbing[1].chosen
    part = recording.only(np.arange(int(0.8 * len(recording))))
    found = search_chain(pendulum(20.0, 0.1), [part], good(part), known=[whole])
    assert found.chosen.names == whole.names
    assert found.chosen.log_odds == whole.log_odds


def test_a_sign_that_is_missing_is_no_noise():
    """A retuned model without it misses by whole swings from row to row; noise is what is left with it."""
    rng, t, sd = np.random.default_rng(3), 0.02 * np.arange(1500), 0.02
    u = np.repeat(rng.normal(size=150), 10)
    y, state = np.empty(t.size), 0.0
    for k in range(t.size):
        y[k] = abs(state)
        state = u[k] + (state - u[k]) * math.exp(-0.02 / 0.08)
    recording = Recording(t=t, u=u, y=y + sd * rng.normal(size=t.size))
    block = Block(name="drive", place="plant", dynamics=TransferFunction(num=(1.0,), den=(0.08, 1.0)), output="speed")
    model = Model(name="drive", input=Port(), output=Port(), blocks=(block,))
    told = diagnose(model, [recording], without=[k.name for k in ALL if k.name != "sensor.absolute_value"])
    assert [e.name for e in told.effects] == ["sensor.absolute_value"]
    assert told.fit.noise_floor == pytest.approx(sd / np.std(recording.y), rel=0.1)


def carriage(level: float, cogging: float) -> Recording:
    """tau dv/dt = -v + .159 (3.3 u - level sign(v) - cogging sin(27 x)), sticking at rest; u turns at two places.

    Each time it is another one of two commands: under one alone, friction is a smaller gain and another lag.
    """
    rng, rows, dt, h = np.random.default_rng(2), 2000, 0.007, 0.007 / 8
    u, y, (x, v), sign = np.empty(rows), np.empty(rows), (0.4, 0.0), 1.0
    size = 4.0
    for k in range(rows):
        turned = -1.0 if x > 0.55 else 1.0 if x < 0.4 else sign
        size, sign = size if turned == sign else 5.5 - size, turned
        u[k], y[k] = size * sign, x
        for _ in range(8):
            drive = 3.3 * u[k] - cogging * math.sin(27.0 * x) - v / 0.159
            held = v == 0.0 and abs(drive) <= level
            w = 0.0 if held else v + h * 0.159 * (drive - level * math.copysign(1.0, v or drive))
            v = 0.0 if v * w < 0.0 else w
            x += h * v
    return Recording(t=dt * np.arange(rows), u=u, y=y + 2e-4 * rng.normal(size=rows))


def test_numbers_of_what_integrates_do_not_hang_on_which_of_its_fits_is_taken():
    """A carriage on an uneven rail: a fit with six times the level and one that is near end at the same numbers."""
    blocks = (
        Block(name="motor", place="actuator", dynamics=TransferFunction(num=(3.3,), den=(1.0,)), output="force"),
        Block(name="cart", place="plant", dynamics=TransferFunction(num=(0.159,), den=(1.0, 1.0, 0.0)), output="x"),
    )
    model = Model(name="carriage", input=Port(unit="A"), output=Port(unit="m"), blocks=blocks)
    recording = carriage(1.2, 1.3)
    friction = "plant.coulomb_friction"
    found = search_chain(model, [recording], good(recording), left_out=[k.name for k in ALL if k.name != friction])
    best = next(j for j in found.judged if j.names == (friction,))
    far = best.fit.theta + np.array([f.kind == "effect" for f in best.fit.parametrisation.free]) * math.log(6.0)
    held = np.zeros(far.size, dtype=bool)
    long, short = (fit(best.fit.parametrisation, d, far, free=held) for d in (best.data, best.few))
    stuck = replace(best, fit=long, short=short)

    def level(one: JudgedChain) -> float:
        return one.fit.model.effects[0].parameters["level"].value

    assert level(stuck) > 4.0
    assert level(at_both_scales(stuck, [stuck])) != level(at_both_scales(best, [best]))
    assert level(at_both_scales(stuck, [stuck, best])) == level(at_both_scales(best, [stuck, best]))
    assert level(at_both_scales(best, [stuck, best])) == pytest.approx(1.2, rel=0.3)


def test_beside_an_effect_that_does_not_lead_alone_the_next_one_is_sought_in_what_that_leaves(tmp_path):
    """An oven that radiates and a valve that sticks: either alone is too rare to lead, and a first look tells both.

    What an effect promises beside another is counted in units of what the other leaves, not of what both leave.
    """
    write_case(310219, tmp_path, tmp_path / "answer.json")
    recordings = [read_recording(tmp_path / name) for name in ("rec1.csv", "rec2.csv")]
    both = {"plant.radiation_loss", "actuator.stiction"}
    events = {"environment.loss_step", "environment.gain_step", "actuator.gain_drift", "timing.clock_error"}
    lags = {"actuator.lag", "sensor.lag", "timing.dead_time"}
    others = {"actuator.backlash", "actuator.saturation"}
    found = search_chain(
        read_model(tmp_path / "model.toml"), recordings, [np.isfinite(r.y) for r in recordings],
        left_out=[k.name for k in ALL if k.name not in both | events | lags | others],
        limits=replace(IN_USE, rig_effects=2),
    )  # fmt: skip
    assert set(found.chosen.names) == both
