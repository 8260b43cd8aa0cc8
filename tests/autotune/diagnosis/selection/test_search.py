"""What the search must find although nothing smooth leads there: a load's phase, a sticking valve, a slow mode."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.parameters import effect_with
from autotune.diagnosis.fitting.restarts import realign_effects
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.selection.hypothesis import Hypothesis, is_stand_in
from autotune.diagnosis.selection.prediction import extend
from autotune.diagnosis.selection.scan import search_starts
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import ALL, CATALOGUE
from autotune.models import Block, Effect, Model, Port, TransferFunction
from autotune.recording import Recording
from tests.autotune.diagnosis.servo_rigs import GAIN, servo_model, servo_recording


def valve(band: float, seed: int, rows: int = 600) -> Recording:
    """Lag of 2 s behind a valve that stays until the command is ``band`` away, then jumps to it."""
    rng = np.random.default_rng(seed)
    dt, w, x = 0.1, 0.0, 0.0
    u = 0.5 * np.sin(np.arange(rows) * dt * 0.7) + np.repeat(rng.uniform(-0.5, 0.5, rows // 50 + 1), 50)[:rows]
    y = np.empty(rows)
    for k in range(rows):
        y[k] = x
        w = u[k] if abs(u[k] - w) > band else w
        x = w + (x - w) * np.exp(-dt / 2.0)
    return Recording(t=np.arange(rows, dtype=np.float64) * dt, u=u, y=y + 0.01 * rng.normal(size=rows))


def converted(step: float, origin: float, seed: int, rows: int = 2000) -> Recording:
    """Lag of 2 s behind a converter of the command, which swings and jitters as a controller's does."""
    rng = np.random.default_rng(seed)
    dt, x = 0.1, 0.0
    u = 0.7 * np.sin(np.arange(rows) * dt * 0.7) + 0.1 * rng.normal(size=rows)
    y = np.empty(rows)
    for k in range(rows):
        y[k] = x
        w = origin + step * np.floor((u[k] - origin) / step + 0.5)
        x = w + (x - w) * np.exp(-dt / 2.0)
    return Recording(t=np.arange(rows, dtype=np.float64) * dt, u=u, y=y + 0.04 * step * rng.normal(size=rows))


def stepped(step: float, origin: float, seed: int, held: int = 80, rows: int = 4000) -> Recording:
    """Lag of 2 s behind a converter of a command that takes few values, each held for a while; noise of .3 steps."""
    rng = np.random.default_rng(seed)
    u = 50.0 + np.repeat(np.round(rng.uniform(-12.0, 12.0, rows // held), 3), held)
    w = origin + step * np.floor((u - origin) / step + 0.5)
    a = np.exp(-0.1 / 2.0)
    y = lfilter([0.0, 1.0 - a], [1.0, -a], w - 50.0, zi=[0.0])[0]
    return Recording(t=0.1 * np.arange(rows), u=u, y=y + 0.3 * step * rng.normal(size=rows))


def tank(share: float, seed: int, rows: int = 800) -> Recording:
    """Lag of 10 s of whose reading a share follows with a further 60 s."""
    rng = np.random.default_rng(seed)
    dt, x, slow = 1.0, 0.0, 0.0
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 40 + 1), 40)[:rows]
    y = np.empty(rows)
    for k in range(rows):
        y[k] = (1.0 - share) * x + share * slow
        for _ in range(10):
            slow += dt / 10 * (x - slow) / 60.0
            x = u[k] + (x - u[k]) * np.exp(-dt / 10 / 10.0)
    return Recording(t=np.arange(rows, dtype=np.float64) * dt, u=u, y=y + 0.01 * rng.normal(size=rows))


def lag(time_constant: float) -> Model:
    block = Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(time_constant, 1.0)))
    return Model(name="lag", input=Port(unit="V"), output=Port(unit="m"), blocks=(block,))


def test_a_loads_frequency_is_found_to_a_hundredth_of_what_the_recording_resolves() -> None:
    hertz, rows = 1.3956, 1000

    def shaken(seed: int) -> Recording:
        clock = iter(0.02 * np.repeat(np.arange(rows), 5) + 0.004 * np.tile(np.arange(5), rows))

        def load(x: float, v: float) -> float:
            return 0.1 * float(np.sin(2.0 * np.pi * hertz * next(clock)))

        return servo_recording(seed, load, rows=rows)

    rigs = [shaken(1), shaken(2)]
    data, base = prepare(servo_model(), rigs, inspect(rigs)[0])
    with ThreadPoolExecutor(1) as pool:
        start = search_starts("environment.periodic_load", base, data, pool)[0]
    p, theta, states = extend(base, start, data)
    found = fit(p, data, theta, states, iterations=30).model.effects[0].parameters
    assert abs(found["frequency"].value - hertz) < 0.01 / (rows * 0.02)
    assert np.hypot(found["in_phase"].value, found["quadrature"].value) == pytest.approx(0.1, rel=0.03)


def test_the_band_of_a_sticking_valve_is_found_on_a_criterion_of_narrow_peaks() -> None:
    r = [valve(0.083, 3), valve(0.083, 4)]
    data, base = prepare(lag(2.0), r, inspect(r)[0])
    with ThreadPoolExecutor(1) as pool:
        starts = search_starts("actuator.stiction", base, data, pool)
    assert starts[0].parameters["band"].value == pytest.approx(0.083, rel=0.02)


@pytest.mark.parametrize("step", [0.03, 0.2, 0.9])
def test_a_converters_step_is_a_line_of_the_residual_over_the_command(step: float) -> None:
    # levels 0.41 + k step, a small share of the command's spread of 0.5 to twice of it
    r = [converted(step, 0.41, 5), converted(step, 0.41, 6)]
    data, base = prepare(lag(2.0), r, inspect(r)[0])
    with ThreadPoolExecutor(1) as pool:
        found = search_starts("actuator.quantisation", base, data, pool)[0].parameters
    levels = (0.41 - found["origin"].value) / found["step"].value
    # so near that the levels are a tenth of a step off at most where u, within 1 V of its middle, is farthest
    assert found["step"].value == pytest.approx(step, rel=0.1 * step)
    assert levels == pytest.approx(round(levels), abs=0.1)


@pytest.mark.parametrize(("step", "origin"), [(0.12, 50.0), (0.164, 50.0), (0.164, 0.0), (0.91, 50.0), (0.31, 0.0)])
def test_a_converters_step_is_found_where_a_command_takes_few_values(step: float, origin: float) -> None:
    # counted from zero or from the operating point; lines over fifty values are many and as strong
    r = [stepped(step, origin, 11), stepped(step, origin, 12)]
    model = replace(lag(2.0), input=Port(unit="%", offset=50.0))
    data, base = prepare(model, r, inspect(r)[0])
    with ThreadPoolExecutor(1) as pool:
        found = search_starts("actuator.quantisation", base, data, pool)[0].parameters
    assert found["step"].value == pytest.approx(step, rel=2e-3)


def test_a_converter_that_is_off_its_levels_is_moved_onto_them() -> None:
    r = [converted(0.05, 0.01, 7), converted(0.05, 0.01, 8)]
    data, base = prepare(lag(2.0), r, inspect(r)[0])
    found = []
    for step, origin in ((0.0504, 0.012), (0.05, 0.01)):
        p, theta, states = extend(base, effect_with("actuator.quantisation", (step, origin)), data)
        found.append(fit(p, data, theta, states))
    stuck, truth = found
    moved = realign_effects(stuck, data)
    assert stuck.cost > 1.1 * truth.cost
    assert moved.cost < 1.02 * truth.cost
    assert moved.model.effects[0].parameters["step"].value == pytest.approx(0.05, rel=0.002)


def test_what_a_slow_mode_explains_better_than_any_effect_is_named_after_none() -> None:
    r = [tank(0.08, 5), tank(0.08, 6)]
    few = ("plant.hysteresis", "environment.drifting_load", "actuator.lag")
    found = search_chain(lag(11.0), r, inspect(r)[0], [k.name for k in ALL if k.name not in (*few, "plant.slow_mode")])
    assert found.chosen.names == ("plant.slow_mode",)
    assert diagnose(lag(11.0), r, without=[name for name in CATALOGUE if name not in few]).effects == ()


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("plant.sine_torque", lambda way: (0.5 * way, 6.0 * way, 0.0)),
        ("plant.hysteresis", lambda way: (1.2 * way, 4.0 * way)),
    ],
)
def test_a_spring_by_another_name_is_refused(name: str, values: Callable[[float], tuple[float, ...]]) -> None:
    r = [servo_recording(seed, lambda x, v: -0.3 * x) for seed in (1, 2)]
    data, base = prepare(servo_model(), r, inspect(r)[0])
    positions = np.concatenate([s[:, 2] for s in base.signals])
    way = float(np.nanmax(positions) - np.nanmin(positions))

    def fitted(effect: Effect) -> Hypothesis:
        p, theta, states = extend(base, effect, data)
        return Hypothesis(names=(effect.name,), fit=fit(p, data, theta, states, iterations=30))

    spring = fitted(effect_with("plant.leak", (0.3 * GAIN,)))
    other = fitted(effect_with(name, values(way)))
    assert spring.fit.model.effects[0].parameters["rate"].value == pytest.approx(0.3 * GAIN, rel=0.05)
    # as good an explanation to within a few units of chi2, at the price of more numbers
    assert other.fit.chi2 < spring.fit.chi2 + 0.02 * (base.chi2 - spring.fit.chi2)
    assert is_stand_in(other, data)
    assert not is_stand_in(spring, data)


def test_a_cogging_torque_that_was_travelled_over_is_no_stand_in() -> None:
    r = [servo_recording(seed, lambda x, v: -0.1 * float(np.sin(2.0 * np.pi * x))) for seed in (1, 2)]
    few = ("plant.sine_torque", "plant.leak")
    found = search_chain(servo_model(), r, inspect(r)[0], [k.name for k in ALL if k.name not in few])
    assert found.chosen.names == ("plant.sine_torque",)
    assert found.chosen.fit.model.effects[0].parameters["period"].value == pytest.approx(1.0, rel=0.01)


def test_a_hysteresis_has_its_numbers_where_rows_are_left_out_between_windows() -> None:
    amplitude, width = 0.15, 0.3
    turned, before = 0.0, 0.0

    def force(x: float, v: float) -> float:
        nonlocal turned, before
        travel, before = (x - before) / width, x
        turned += travel - abs(travel) * turned
        return -amplitude * turned

    r = servo_recording(5, force, rows=16000)
    left_out = [k.name for k in ALL if k.name not in ("plant.hysteresis", "plant.coulomb_friction", "plant.resonance")]
    found = search_chain(servo_model(), [r], [np.ones(len(r), dtype=bool)], left_out)
    assert found.chosen.names == ("plant.hysteresis",)
    assert found.chosen.added[0].values == pytest.approx({"amplitude": amplitude, "width": width}, rel=0.05)


def test_of_a_long_recording_some_windows_tell_the_same() -> None:
    rows, decay = 3000, float(np.exp(-0.1))
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 40), 40)
    y = np.zeros(rows)
    for k in range(rows - 1):
        y[k + 1] = decay * y[k] + (1.0 - decay) * min(max(u[k], -0.6), 0.6)
    recording = Recording(t=0.1 * np.arange(rows), u=u, y=y + 0.01 * rng.standard_normal(rows))
    every = [np.ones(rows, dtype=bool)]
    few = ("actuator.saturation", "actuator.nonlinear_gain", "actuator.lag")
    without = [k.name for k in ALL if k.name not in few]
    limits = replace(IN_USE, searched_rows=1000, rig_rows=600)
    found = search_chain(lag(1.0), [recording], every, without, limits=limits)
    whole = search_chain(lag(1.0), [recording], every, without)
    assert found.chosen.names == whole.chosen.names == ("actuator.saturation",)
    assert found.chosen.fit.residuals[0].size == rows
    np.testing.assert_allclose(found.chosen.fit.theta, whole.chosen.fit.theta, rtol=2e-2, atol=2e-2)
