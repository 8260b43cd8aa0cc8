"""Effects put into recordings: what they are held against is written here anew."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.signal import lfilter, lsim

from sim.conceal.retune import Chain as OwnChain
from sim.conceal.retune import discretise as own_discretise
from sim.conceal.retune import free_runs
from sim.recorded import cases, commands, readings
from sim.recorded.chain import Block, Chain, discretise, forecast_error, moved, residuals, retune
from sim.recorded.effects import BY_NAME, EFFECTS, require_exact, require_no_converter
from sim.recorded.readings import Scale
from sim.recorded.rigs import Record, RefusedError, find, read
from tests.sim.recorded_rig import NOISE, record, write_recording, write_rig

SCALE = Scale(
    u0=0.5, y0=1.0, du=1.0, dy=2.0, u_span=6.0, y_low=-4.0, y_high=6.0, noise=0.1, tau=0.5, length=30.0, Ts=0.02,
    unit_u="V", unit_y="rad",
)  # fmt: skip
SEEDS = st.integers(0, 10_000)
SIZES = st.floats(0.05, 2.0)


def random(seed, levels):
    """A recording with a command of few levels, as a relay's, or of many."""
    rng = np.random.default_rng(seed)
    u = rng.choice(rng.uniform(-2, 3, 4), 400) if levels else rng.uniform(-2, 3, 400)
    return Record(name="fit", t=np.arange(400) * 0.02, u=u, y=np.cumsum(rng.normal(0, 0.1, 400)))


def before(effect, size, r, seed):
    """The command before an effect, and the effect's parameters."""
    put = effect(size, SCALE, np.random.default_rng(seed))
    return put.apply(r, np.random.default_rng(1)), {name: value for name, (value, _) in put.parameters.items()}


@given(SEEDS, SIZES, st.booleans())
def test_a_dead_zone_turns_the_changed_command_into_the_recorded_one(seed, size, levels):
    r = random(seed, levels)
    assume(0.05 < np.mean(r.u > 0.5) < 0.95)
    v, p = before(commands.dead_zone, size, r, seed)
    dv = v.u - 0.5
    assert np.allclose(0.5 + np.sign(dv) * np.maximum(np.abs(dv) - p["half_width"], 0.0), r.u, atol=1e-12)


@given(SEEDS, st.floats(0.05, 0.8), st.booleans())
def test_a_bent_gain_turns_the_changed_command_into_the_recorded_one(seed, size, levels):
    r = random(seed, levels)
    v, p = before(commands.nonlinear_gain, size, r, seed)
    dv = v.u - 0.5
    assert np.allclose(0.5 + dv + p["second_order"] * dv**2, r.u, atol=1e-12)


@given(SEEDS, SIZES, st.booleans())
def test_play_turns_the_changed_command_into_the_recorded_one(seed, size, levels):
    r = random(seed, levels)
    v, p = before(commands.backlash, size, r, seed)
    held, out = r.u[0], []
    for command in v.u:
        held = min(max(held, command - p["half_width"]), command + p["half_width"])
        out.append(held)
    assert np.allclose(out, r.u, atol=1e-12)


@given(SEEDS, SIZES)
def test_a_drives_filter_turns_the_changed_command_into_the_recorded_one(seed, size):
    r = random(seed, levels=True)
    v, p = before(commands.lag, size, r, seed)
    keep = np.exp(-0.02 / p["time_constant"])
    out = lfilter([1.0 - keep], [1.0, -keep], v.u, zi=[keep * r.u[0]])[0]
    assert np.allclose(out, r.u, atol=1e-9)


@given(SEEDS, st.floats(0.05, 1.9))
def test_a_gain_that_drifts_turns_the_changed_command_into_the_recorded_one(seed, size):
    r = random(seed, levels=False)
    v, p = before(commands.gain_drift, size, r, seed)
    assert np.allclose(0.5 + (v.u - 0.5) * (1.0 + p["rate"] * r.t), r.u, atol=1e-12)


@given(SEEDS, SIZES)
def test_command_and_load_together_are_the_recorded_command(seed, size):
    r = random(seed, levels=True)
    v, p = before(commands.drifting_load, size, r, seed)
    assert np.allclose(v.u + p["rate"] * r.t, r.u, atol=1e-12)
    v, p = before(commands.step_load, size, r, seed)
    assert np.allclose(np.unique(np.round(r.u - v.u, 9)), sorted((0.0, np.round(p["size"], 9))))
    assert np.all(v.y == r.y)


def test_a_lag_of_the_reading_is_the_first_order_lag_of_straight_lines():
    r = random(3, levels=False)
    v, p = before(readings.lag, 0.3, r, 0)
    exact = lsim(([1.0], [p["time_constant"], 1.0]), r.y - r.y[0], r.t, interp=True)[1] + r.y[0]
    assert np.allclose(v.y, exact, atol=1e-9)


@given(SEEDS, SIZES)
def test_a_dead_time_pairs_every_command_with_the_reading_of_rows_before(seed, size):
    r = random(seed, levels=False)
    v, p = before(readings.dead_time, size, r, seed)
    late = round(p["dead_time"] / 0.02)
    assert np.array_equal(v.y, r.y[:-late])
    assert np.array_equal(v.u, r.u[late:])
    assert np.array_equal(v.t, r.t[late:])


@given(SEEDS, st.floats(0.1, 2.0))
def test_readings_are_cut_rounded_and_held_as_is_said(seed, size):
    r = random(seed, levels=False)
    scale = {
        **SCALE.__dict__,
        "y_low": float(r.y.min()),
        "y_high": float(r.y.max()),
        "noise": 0.05 * float(np.ptp(r.y)),
    }
    s, rng = Scale(**scale), np.random.default_rng
    assume(size * s.noise < 0.1 * s.y_span)
    step = readings.quantisation(size, s, rng(seed))
    y = step.apply(r, rng(1)).y / step.parameters["step"][0]
    assert np.allclose(y, np.round(y), atol=1e-9)
    lost = readings.dropout(size, s, rng(seed)).apply(r, rng(1)).y
    changed = np.flatnonzero(lost != r.y)
    assert np.all(lost[changed] == lost[changed - 1])
    spikes = readings.outliers(2.0, s, rng(seed))
    hit = np.abs(spikes.apply(r, rng(1)).y - r.y)
    assert np.allclose(hit[hit > 0.0], spikes.parameters["size"][0])


def test_what_would_cut_off_half_of_a_recording_is_refused():
    r = random(1, levels=False)
    s = replace(SCALE, y_low=float(r.y.min()), y_high=float(r.y.max()))
    with pytest.raises(RefusedError, match="cut off"):
        readings.saturation(19.0, s, np.random.default_rng(0)).apply(r, np.random.default_rng(0))


TANK = Chain(
    blocks=(Block(num=(1.0,), den=(9.0, 1.0)), Block(num=(2.9,), den=(35.0, 1.0), delay=2.3)),
    u_offset=50.0,
    y_offset=160.0,
)


def test_a_chain_runs_as_the_one_that_the_generator_of_simulated_cases_has():
    own = own_discretise(
        OwnChain(
            integrating=False, K=2.9, tau_actuator=9.0, tau_plant=35.0, tau_sensor=0.0, delay=2.3, u_offset=50.0,
            y_offset=160.0,
        ), 1.0,
    )  # fmt: skip
    steps = discretise(TANK, 1.0)
    u = np.repeat(np.random.default_rng(0).uniform(-10, 10, 20), 15)
    x, y = np.zeros(2), []
    for k in range(len(u)):
        y.append(own.c @ x)
        x = own.A @ x + own.b_before * u[max(k - own.rows - 1, 0)] + own.b_after * u[max(k - own.rows, 0)]
    assert np.allclose(free_runs(steps, u, 0, 1, len(u))[0], y, atol=1e-9)


def test_a_block_that_passes_steps_at_once_shows_them_in_the_next_row():
    speed, damper = Block(num=(1.0, 0.0), den=(0.01, 1.0)), Block(num=(3.0,), den=(1.0,))
    chain = Chain(blocks=(speed, damper), u_offset=0.0, y_offset=0.0)
    t = np.arange(100) * 0.01
    u = np.where(t >= 0.2, 1.0, 0.0)
    y = free_runs(discretise(chain, 0.01), u, 0, 1, 100)[0]
    assert np.allclose(y[:21], 0.0)
    assert np.allclose(y[21:], 300.0 * np.exp(-(t[21:] - 0.2) / 0.01), rtol=1e-9, atol=1e-9)


def test_a_refit_finds_numbers_that_are_wrong_and_leaves_the_noise():
    rng = np.random.default_rng(5)
    true = moved(TANK, np.array([0.2, -0.3, 0.15, 0.3, 4.0]))
    records = []
    noise = rng.normal(0.0, 0.1, (2, 1800))
    for e in noise:
        u = 50.0 + np.repeat(rng.uniform(-10, 10, 60), 30)
        records.append((u, free_runs(discretise(true, 1.0), u - 50.0, 0, 1, 1800)[0] + true.y_offset + e))
    numbers, rms = retune(TANK, records, 1.0, 600)
    assert numbers == pytest.approx([0.2, -0.3, 0.15, 0.3, 4.0], abs=0.03)
    assert rms == pytest.approx(0.1, rel=0.05)
    e = forecast_error(true, *records[0], 1.0, 150)
    assert np.std(e) == pytest.approx(np.std(noise[0, 300:]), rel=0.02)
    assert np.sqrt(np.mean(residuals(true, *records[0], 1.0, 600) ** 2)) == pytest.approx(0.1, rel=0.06)


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    return cases.prepare(read(write_rig(tmp_path_factory.mktemp("servo")), "servo"))


def test_the_residual_of_a_linear_rig_is_its_noise(ready):
    assert ready.noise == pytest.approx(NOISE, rel=0.05)
    assert [len(ready.rig.given), len(ready.rig.kept_back)] == [1, 1]


@pytest.mark.parametrize("seed", range(100_000, 100_000 + len(EFFECTS) + 3, 4))
def test_a_case_is_its_seeds_and_has_the_strength_that_it_says(ready, seed):
    made = cases.make(seed, [ready])
    answer = cases.answer(made, seed)
    assert answer == cases.answer(cases.make(seed, [ready]), seed)
    if answer["kind"] == "single":
        low, high = cases.STRENGTHS[answer["strength"]]
        assert low <= answer["retuned_train_ratio"] <= high
        assert answer["effects"][0]["name"] in answer["effects"][0]["accept"]
    else:
        assert answer["retuned_train_ratio"] == pytest.approx(1.0, abs=0.25)


def test_seeds_go_round_rigs_and_effects(ready):
    first = [cases._in_turn(place, np.random.default_rng(0)) for place in range(len(EFFECTS) + cases.NUMBERS)]
    assert [order[0] for order in first if order] == list(EFFECTS)
    assert sum(not order for order in first) == cases.NUMBERS
    assert all(len({e.name for e in order}) == len(EFFECTS) for order in first if order)


def test_a_command_that_does_not_move_takes_no_effect_of_the_command(tmp_path):
    t, _, y = record(1)
    write_rig(tmp_path)
    write_recording(tmp_path / "fit.csv", t, np.full(len(t), 0.5), y)
    rig = read(tmp_path, "still")
    with pytest.raises(RefusedError, match="u is constant"):
        require_exact(BY_NAME["actuator.backlash"], rig, 1.0)
    require_exact(BY_NAME["sensor.saturation"], rig, 1.0)
    with pytest.raises(RefusedError, match="from row to row"):
        require_exact(BY_NAME["sensor.lag"], rig, 1e-6)


def test_a_change_that_a_converter_to_the_recorded_levels_would_undo_is_refused():
    relay = Record(name="fit", t=np.arange(40) * 0.1, u=np.repeat([2.0, 6.0], 20), y=np.zeros(40))
    small, large = (replace(relay, u=relay.u + size * np.sin(relay.t)) for size in (1.5, 2.5))
    with pytest.raises(RefusedError, match="converter"):
        require_no_converter([relay], [small])
    require_no_converter([relay], [large])
    require_no_converter([relay], [relay])  # an effect of the reading


def test_a_folder_that_cannot_be_used_says_why(tmp_path):
    for name in ("good", "uneven", "two", "bare", "equations"):
        write_rig(tmp_path / name, rows=200)
    t, u, y = record(1, 200)
    write_recording(tmp_path / "uneven" / "fit.csv", t + 0.015 * (np.arange(200) % 2), u, y)
    (tmp_path / "two" / "model_2.toml").write_text("")
    write_recording(tmp_path / "bare" / "fit.csv", t, u, y, header="time,u,y")
    (tmp_path / "equations" / "model.toml").write_text('[[input]]\ncolumn = "u"\n')
    rigs, refused = find(tmp_path)
    assert [rig.name for rig in rigs] == ["good"]
    for name, reason in {"uneven": "apart", "two": "several models", "bare": "header", "equations": "chain"}.items():
        assert reason in refused[name]


def test_a_set_point_or_a_stated_law_tells_a_closed_loop(tmp_path):
    write_rig(tmp_path)
    assert not read(tmp_path, "open").closed_loop
    (tmp_path / "fit.toml").write_text('[controller]\nkind = "pi"\nK = 1.0\nTi_s = 1.0\n')
    assert read(tmp_path, "closed").closed_loop
