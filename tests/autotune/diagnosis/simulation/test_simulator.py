"""The compiled chain against closed forms: exact between samples, whatever the lags; sticking is exact."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from autotune.diagnosis.fitting.parameters import effect_with
from autotune.diagnosis.simulation.assembly import assemble, spans_of
from autotune.diagnosis.simulation.simulator import Simulator, Windows
from autotune.diagnosis.simulation.transitions import transition_table
from autotune.effects import KINDS
from autotune.errors import InputError
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording


def servo(lag_s: float = 0.01, delay_s: float = 0.0, effects: tuple[Effect, ...] = ()) -> Model:
    return Model(
        name="servo",
        input=Port(unit="V"),
        output=Port(unit="rad"),
        blocks=(
            Block(
                name="drive",
                place="actuator",
                dynamics=TransferFunction(num=(1.0,), den=(lag_s, 1.0), delay_s=delay_s),
            ),
            Block(name="speed", place="plant", dynamics=TransferFunction(num=(5.0,), den=(0.25, 1.0))),
            Block(name="position", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0))),
        ),
        effects=effects,
    )


def effect(name: str, **values: float) -> Effect:
    return Effect(name=name, parameters=MappingProxyType({key: Parameter(value=v) for key, v in values.items()}))


def recording(u: np.ndarray, dt: float) -> Recording:
    t = dt * np.arange(u.size)
    return Recording(t=t, u=u, y=np.zeros(u.size))


@settings(max_examples=20)
@given(lag=st.floats(1e-4, 0.2), delay=st.floats(0.0, 0.05), dt=st.floats(0.002, 0.05), seed=st.integers(0, 1000))
def test_a_linear_chain_with_a_fractional_dead_time_is_exact_whatever_its_lags(
    lag: float, delay: float, dt: float, seed: int
) -> None:
    u = np.random.default_rng(seed).normal(size=40)
    sim = assemble(servo(lag, delay))
    got = sim.run(recording(u, dt), np.zeros(3))[0][:, 0]
    # reference: superposition of delayed steps through the matrix exponential
    A, b, c = sim.chain.A, sim.chain.B[:, 0], sim.chain.taps[3]
    big = np.zeros((4, 4))
    big[:3, :3], big[:3, 3] = A, b

    def step_response(time: float) -> float:
        return float(c @ expm(big * time)[:3, 3]) if time > 0.0 else 0.0

    changes = np.diff(np.concatenate([[0.0], u]))
    table = {k: step_response(k * dt - delay) for k in range(u.size + 1)}
    # the command before the first row is taken to be the first row's: it acts without delay
    want = [u[0] * step_response(k * dt) + sum(changes[j] * table[k - j] for j in range(1, k)) for k in range(u.size)]
    # a dead time between two nodes of the table is blended: second order in a 64th of the sample time
    tolerance = 2e-4 * float(np.max(np.abs(want))) + 1e-9
    np.testing.assert_allclose(got, want, atol=tolerance)


def test_dry_friction_stops_a_coasting_mass_where_the_closed_form_says_and_holds_it() -> None:
    level, v0, tau, gain = 0.2, 3.0, 0.25, 5.0
    sim = assemble(servo(effects=(effect("plant.coulomb_friction", level=level),)))
    out, _ = sim.run(recording(np.zeros(600), 0.002), np.array([0.0, v0, 0.0]))
    # tau dv/dt = -v - gain level: v reaches 0 at T = tau log(1 + v0/(gain level)), after v0 tau - gain level T
    rest = tau * np.log(1.0 + v0 / (gain * level))
    assert out[-1, 0] == pytest.approx(v0 * tau - gain * level * rest, rel=2e-3)
    assert np.all(out[int(rest / 0.002) + 3 :, 1] == 0.0)


def test_a_push_below_the_friction_level_moves_nothing() -> None:
    sim = assemble(servo(effects=(effect("plant.coulomb_friction", level=0.2),)))
    out, _ = sim.run(recording(np.full(500, 0.19), 0.002), np.zeros(3))
    # what the drive still gains while the mass sticks leaves only rounding of the sub-steps
    assert np.max(np.abs(out[:, 0])) < 1e-5


@given(limit=st.floats(0.1, 2.0))
@settings(max_examples=10)
def test_a_position_never_passes_a_hard_stop(limit: float) -> None:
    sim = assemble(servo(effects=(effect("plant.hard_stop", high=limit),)))
    out, _ = sim.run(recording(np.ones(400), 0.01), np.zeros(3))
    assert out[:, 0].max() == pytest.approx(limit, abs=1e-12)


@given(gain=st.floats(0.01, 300.0), sensed=st.sampled_from((-0.05, 0.05, 1.0, 40.0)), low=st.floats(-2.0, -0.1))
@settings(max_examples=20)
def test_stops_are_where_readings_say_whatever_the_gains_of_plant_and_sensor(
    gain: float, sensed: float, low: float
) -> None:
    stops, high = effect("plant.hard_stop", low=low, high=1.0), 1.0
    plant = Block(name="ball", place="plant", dynamics=TransferFunction(num=(gain,), den=(1.0, 0.5, 0.0)))
    sensor = Block(name="sensor", place="sensor", dynamics=TransferFunction(num=(sensed,), den=(1.0,)))
    tube = Model(name="tube", input=Port(), output=Port(), blocks=(plant, sensor), effects=(stops,))
    there_and_back = np.repeat([1.0, -1.0, 1.0], 40) * 3.0 / abs(gain * sensed)
    out, _ = assemble(tube).run(recording(there_and_back, 0.1), np.zeros(2))
    assert out[:, 0].max() == pytest.approx(high, abs=1e-9)
    assert out[:, 0].min() == pytest.approx(low, abs=1e-9)


def test_windows_that_start_where_the_one_before_ended_are_one_free_run() -> None:
    rng = np.random.default_rng(3)
    r = recording(np.repeat(rng.normal(size=40), 20), 0.005)
    sim = assemble(servo(effects=(effect("plant.quadratic_drag", coefficient=0.1),)))
    whole, _ = sim.run(r, np.array([0.1, 0.2, 0.3]))
    first, rest = (Windows(starts=np.array([a]), stops=np.array([b])) for a, b in ((0, 400), (400, 800)))
    _, ends = sim.run(r, np.array([0.1, 0.2, 0.3]), first)
    second, _ = sim.run(r, ends, rest)
    np.testing.assert_allclose(second[400:], whole[400:], atol=1e-12)


def test_a_hysteresis_goes_on_through_rows_between_windows() -> None:
    """Windows that begin where the free run was are parts of it, wherever they end, and however many begin together."""
    rng = np.random.default_rng(3)
    r, start = recording(np.repeat(rng.normal(size=40), 20), 0.005), np.array([0.1, 0.2, 0.3])
    sim = assemble(servo(effects=(effect("plant.hysteresis", amplitude=0.8, width=0.4),)))
    whole, _ = sim.run(r, start)
    first, some = np.array([0, 300, 300, 550]), np.array([100, 300, 420, 700])
    states = [sim.run(r, start, Windows(starts=np.array([0]), stops=np.array([k])))[1][0] for k in first]
    parts, ends = sim.run(r, np.array(states), Windows(starts=first, stops=some))
    for a, b in zip(first, some, strict=True):
        np.testing.assert_allclose(parts[a:b], whole[a:b], atol=1e-12)
    np.testing.assert_allclose(ends[1], states[1], atol=0.0)


def test_an_effect_that_the_chain_has_no_place_for_is_refused() -> None:
    tank = Model(
        name="tank",
        input=Port(),
        output=Port(),
        blocks=(Block(name="tank", place="plant", dynamics=TransferFunction(num=(1.0,), den=(30.0, 1.0))),),
        effects=(effect("plant.coulomb_friction", level=0.1),),
    )
    with pytest.raises(InputError, match="dry friction needs a speed"):
        assemble(tank)


def test_an_unknown_effect_and_a_missing_parameter_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"plant\.gremlin"):
        assemble(servo(effects=(effect("plant.gremlin", level=1.0),)))
    with pytest.raises(InputError, match="time_constant"):
        assemble(servo(effects=(effect("sensor.lag"),)))


@settings(max_examples=20)
@given(step=st.floats(0.05, 0.5), origin=st.floats(-1.0, 1.0), seed=st.integers(0, 1000))
def test_a_converters_levels_pass_through_its_origin(step: float, origin: float, seed: int) -> None:
    u = np.random.default_rng(seed).normal(size=60)
    rounded = origin + step * np.floor((u - origin) / step + 0.5)
    stepped = assemble(servo(effects=(effect("actuator.quantisation", step=step, origin=origin),)))
    got, _ = stepped.run(recording(u, 0.01), np.zeros(3))
    want, _ = assemble(servo()).run(recording(rounded, 0.01), np.zeros(3))
    np.testing.assert_allclose(got, want, atol=1e-10)


@pytest.mark.parametrize("friction", ["plant.coulomb_friction", "plant.stribeck_friction"])
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.4), st.floats(0.0, 0.05))
def test_dry_friction_alone_is_simulated_as_beside_a_load_of_nothing(
    friction: str, seed: int, level: float, delay: float
) -> None:
    rng = np.random.default_rng(seed)
    dynamics = TransferFunction(num=(4.0,), den=(0.3, 1.0, 5.0), delay_s=delay)
    plain = Model(name="m", input=Port(), output=Port(), blocks=(Block(name="b", place="plant", dynamics=dynamics),))
    t = np.cumsum(rng.uniform(0.01, 0.04, 300))
    recording = Recording(t=t, u=np.repeat(rng.normal(size=30), 10), y=0.0 * t)
    values = (level,) if friction == "plant.coulomb_friction" else (level, 2.0 * level, 0.1)
    alone = replace(plain, effects=(effect_with(friction, values),))
    beside = replace(plain, effects=(*alone.effects, effect_with("environment.drifting_load", (0.0,))))
    runs = [assemble(model).run(recording, np.zeros(2))[0] for model in (alone, beside)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.ptp(runs[0][:, 0]) > 0.0


def test_a_recording_of_which_no_row_counts_says_nothing_of_the_states_sizes() -> None:
    sim = assemble(servo())
    u, y = np.array([0.0, 1.0, 0.0]), np.array([0.0, 2.0, 1.0])
    alone, nothing = sim.state_sizes(*spans_of([u], [y]), 0.1), y[:0]
    assert np.array_equal(sim.state_sizes(*spans_of([u, u], [nothing, y]), 0.1), alone)
    assert np.array_equal(sim.state_sizes(*spans_of([u, u], [y, nothing]), 0.1), alone)
    assert np.all(np.isfinite(sim.state_sizes(*spans_of([u], [nothing]), 0.1)))


@settings(max_examples=30)
@given(
    rates=st.lists(st.floats(0.1, 10.0), min_size=2, max_size=2, unique=True),
    second=st.integers(-20, 20), gain=st.integers(-40, 40), step=st.floats(0.01, 3.0),
)  # fmt: skip
def test_a_transition_is_as_exact_in_all_units(rates: list[float], second: int, gain: int, step: float) -> None:
    a, b = rates
    A = np.array([[-a, 0.0], [2.0**gain, -b]]) * 2.0**-second
    B = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) * 2.0**-second
    found = transition_table(A, B, step * 2.0**second)[-1]
    usual = transition_table(np.array([[-a, 0.0], [1.0, -b]]), B * 2.0**second, step)[-1]
    np.testing.assert_array_equal(found[1, [0, 2]], 2.0**gain * usual[1, [0, 2]])
    np.testing.assert_allclose(usual[:, :2], expm(np.array([[-a, 0.0], [1.0, -b]]) * step), rtol=1e-9, atol=1e-12)


@settings(max_examples=30)
@given(second=st.integers(-20, 20), volt=st.integers(-40, 40), metre=st.integers(-40, 40), y=st.floats(-2.0, 2.0))
def test_rest_and_sizes_of_states_are_in_proportion_to_the_signals(
    second: int, volt: int, metre: int, y: float
) -> None:
    s, v, m = 2.0**second, 2.0**volt, 2.0**metre

    def spring(s: float, v: float, m: float) -> Simulator:
        lag = TransferFunction(num=(3.0,), den=(0.1 * s, 1.0))
        arm = TransferFunction(num=(0.5 * m / v,), den=(1.0 * s**2, 1.4 * s, 12.0))
        blocks = (Block(name="lag", place="actuator", dynamics=lag), Block(name="arm", place="plant", dynamics=arm))
        return assemble(Model(name="arm", input=Port(), output=Port(), blocks=blocks))

    units = np.array([v, m, m / s])  # of the lag's state, of the angle and of its rate
    there, here = spring(s, v, m), spring(1.0, 1.0, 1.0)
    # a reading that no rest under the command has: what gives way hangs on no unit
    for dt in (0.01, 1.0):  # a sample shorter than what is fastest, and one longer
        at_rest, sizes = there.rest_state(0.7 * v, y * m, dt * s), there.state_sizes(2.0 * v, 0.1 * m, dt * s)
        np.testing.assert_allclose(at_rest, units * here.rest_state(0.7, y, dt), rtol=1e-9, atol=0.0)
        np.testing.assert_allclose(sizes, units * here.state_sizes(2.0, 0.1, dt), rtol=1e-9)


@given(shorter=st.floats(1.0, 7.0), u=st.floats(-1.0, 1.0), y=st.floats(-1.0, 1.0))
def test_a_lag_far_faster_than_a_sample_moves_no_other_state(shorter: float, u: float, y: float) -> None:
    """A ball's height integrates its speed: what a sensor does within a sample says nothing of how far they go."""

    def ball(lag_s: float) -> Simulator:
        chain = [("plant", (-65.5,), (0.36, 1.0)), ("plant", (1.0,), (1.0, 0.0)), ("sensor", (1.0,), (lag_s, 1.0))]
        blocks = [
            Block(name=f"{i}", place=where, dynamics=TransferFunction(num=num, den=den))
            for i, (where, num, den) in enumerate(chain)
        ]
        return assemble(Model(name="ball", input=Port(), output=Port(), blocks=tuple(blocks)))

    dt = 0.01
    fast, faster = ball(0.01 * dt), ball(0.01 * dt * 0.1**shorter)
    np.testing.assert_allclose(faster.state_sizes(1.0, 0.1, dt), fast.state_sizes(1.0, 0.1, dt), rtol=1e-3)
    np.testing.assert_allclose(faster.state_sizes(0.0, 0.1, dt)[:2], fast.state_sizes(0.0, 0.1, dt)[:2], rtol=1e-2)
    np.testing.assert_allclose(faster.rest_state(u, y, dt), fast.rest_state(u, y, dt), rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.linear and kind.linear.start])
@pytest.mark.parametrize("amplifier", [1.0, 30.0])
def test_a_block_that_an_effect_adds_begins_at_rest_beside_the_others(name: str, amplifier: float) -> None:
    lag = TransferFunction(num=(amplifier,), den=(0.1, 1.0))
    slow = Block(name="oven", place="plant", dynamics=TransferFunction(num=(5.0,), den=(2.0, 1.0)))
    part = KINDS[name].linear
    assert part is not None
    assert part.start is not None
    driven = () if part.unless_lagged else (Block(name="amplifier", place="actuator", dynamics=lag),)
    model = Model(name="oven", input=Port(), output=Port(), blocks=(*driven, slow))
    values = {"share": 0.3, "frequency": 4.0, "damping": 0.1} | dict.fromkeys(
        ("time_constant", "time_constant_up", "time_constant_down"), 0.4
    )
    added = effect(name, **{q.name: values[q.name] for q in KINDS[name].parameters})
    small, large = assemble(model).chain, assemble(replace(model, effects=(added,))).chain
    x = np.linalg.solve(small.A, -small.B[:, 0])
    more = part.start(np.array([1.0]), np.array([small.taps[3] @ x]), added.values)[0]
    x = np.concatenate([more, x] if part.at == "front" else [x, more])
    np.testing.assert_allclose(large.A @ x + large.B[:, 0], 0.0, atol=1e-9 * np.abs(large.A).max() * np.abs(x).max())


def tank(effects: tuple[Effect, ...] = ()) -> Model:
    block = Block(
        name="tank", place="plant", output="level", dynamics=TransferFunction(num=(5.3,), den=(82.0, 1.0)), unit="cm"
    )
    return Model(
        name="tank", input=Port(unit="V"), output=Port(unit="cm", offset=9.7), blocks=(block,), effects=effects
    )


def test_the_root_of_a_tanks_level_falls_evenly_once_its_inflow_is_shut() -> None:
    # Torricelli: T dx/dt = K w - 2 X0 (sqrt(1 + x/X0) - 1), and K w = -2 X0 leaves d sqrt(1 + x/X0)/dt = -1/T
    level_cm, dt = 9.7, 0.5
    sim = assemble(tank((effect("plant.sqrt_outflow", operating_level=level_cm),)))
    shut = recording(np.full(100, -2.0 * level_cm / 5.3), dt)
    got = sim.run(shut, np.zeros(sim.order), signals=1)[0][:, 0]
    assert np.allclose(np.sqrt(got / level_cm), 1.0 - shut.t / 82.0, atol=1e-4)


def test_a_second_tanks_level_that_is_given_is_above_zero() -> None:
    with pytest.raises(InputError, match="operating_level_2 = 0"):
        assemble(tank((effect("plant.sqrt_outflow", operating_level=9.7, operating_level_2=0.0),)))


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.is_simulated and kind.possible is None])
def test_an_effect_runs_with_nothing_but_what_has_no_neutral_value(name: str) -> None:
    kind = KINDS[name]
    given = {q.name: 1.0 for q in kind.parameters if q.neutral is None} or {kind.parameters[0].name: 1.0}
    able = [model for model in (tank(), servo()) if kind.needs.holds(assemble(model).chain)]
    assert able
    for model in able:
        sim = assemble(replace(model, effects=(effect(name, **given),)))
        assert np.isfinite(sim.run(recording(np.ones(20), 0.1), np.zeros(sim.order))[0]).all()
