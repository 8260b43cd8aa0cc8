"""Loops in operation: the valve's law, what is said of loops whose cause is known, and what is refused."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from autotune.cli import app
from autotune.diagnosis.routine import RoutineDiagnosis, diagnose_routine
from autotune.diagnosis.routine.kernels import valve_position
from autotune.diagnosis.routine.operation import operation_of
from autotune.diagnosis.routine.oscillation import phase_kept, regularity, setpoint_answer
from autotune.diagnosis.routine.thresholds import RoutineThresholds
from autotune.diagnosis.routine.valves import compare_valves
from autotune.diagnosis.thresholds import table
from autotune.errors import IdentificationError, InputError
from autotune.recording import Recording, read_recording, write_recording
from tests.benchmarks.routine import recorded
from tests.benchmarks.surrogates import surrogate
from tests.sim.linear_loops import linear_loop
from tests.sim.valve_cases import CaseKind, Shape, swung_from_outside, valve_case
from tests.sim.valve_loop import Surroundings, ValveLoop, simulate_loop

LIMITS = RoutineThresholds()
START = np.zeros(1, dtype=np.int64)


def loop_of(kind: str, rows: int = 800, seed: int = 1, **changed: float) -> Recording:
    """Return a recording of a flow loop of 10 s lag and 3 s dead time, with noise and a wandering load."""
    random = np.random.default_rng(seed)
    loop = replace(ValveLoop(gain=1.5, lag_s=10.0, dead_time_s=3.0, K=0.8, Ti_s=9.0), **changed)
    load = np.convolve(random.normal(size=rows + 200), np.exp(-np.arange(200) / 60.0), "valid")[:rows] * 0.02
    setpoint = np.zeros(rows)
    if kind == "outside":
        load = load + 4.0 * np.sin(2.0 * np.pi * np.arange(rows) / 35.0)
    if kind == "tight":
        setpoint = 3.0 * np.where(np.arange(rows) // 70 % 2 == 0, 1.0, -1.0)
    around = Surroundings(setpoint=setpoint, load=load, noise=0.05 * random.normal(size=rows))
    u, y, _ = simulate_loop(loop, around)
    return Recording(t=np.arange(rows, dtype=float), u=u, y=y, extra={"r": setpoint}, name=kind)


@functools.cache
def diagnosed(kind: str) -> RoutineDiagnosis:
    match kind:
        case "stiction":
            return diagnose_routine([loop_of(kind, valve="choudhury", S=6.0, J=4.0)])
        case "play":
            return diagnose_routine([loop_of(kind, valve="play", S=6.0, gain=0.15, integrating=True, second_lag_s=2.0)])
        case "tight":
            return diagnose_routine([loop_of(kind, K=2.6)])
        case _:
            return diagnose_routine([loop_of(kind)])


@pytest.mark.parametrize(
    ("kind", "verdicts"),
    [
        ("stiction", {"stiction", "backlash"}),
        ("play", {"stiction", "backlash"}),
        ("tight", {"tight_tuning"}),
        ("outside", {"outside_oscillation"}),
        ("quiet", {"none"}),
    ],
)
def test_a_loop_whose_cause_is_known_is_named_by_it(kind, verdicts):
    assert diagnosed(kind).verdict in verdicts


@pytest.mark.parametrize("kind", ["stiction", "play"])
def test_the_band_of_a_faulty_valve_lies_in_its_interval(kind):
    band = diagnosed(kind).band
    assert band is not None
    assert band.low <= 6.0 <= band.high
    assert 0.75 < band.value / 6.0 < 1.25


def test_the_answer_to_the_set_point_has_the_loops_own_period_and_damping():
    answer = diagnosed("tight").answer
    assert answer is not None
    assert answer.damping <= 0.1
    # PI with Ti 9 s on a lag of 10 s and 3.5 s of dead time swings at about 4.3 dead times
    assert 12.0 < answer.period_s < 17.0


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), S=st.floats(0.5, 12.0), share=st.floats(0.0, 1.0))
def test_the_fitted_valve_moves_as_simulated_valves_of_the_same_numbers_do(seed, S, share):
    random = np.random.default_rng(seed)
    n = 400
    load = 6.0 * np.sin(2.0 * np.pi * np.arange(n) / 60.0)
    around = Surroundings(setpoint=np.zeros(n), load=load, noise=0.2 * random.normal(size=n))
    for valve, J in (("play", 0.0), ("he", share * S)):
        loop = ValveLoop(valve=valve, S=S, J=J, gain=1.0, lag_s=10.0, dead_time_s=3.0, K=1.2, Ti_s=10.0)
        u, _, position = simulate_loop(loop, around)
        static = 0.5 * (S + J)
        begins = (50.0 - u[0]) / static  # it begins at 50 %
        found = valve_position(u, START, static, 0.5 * (S - J), False, begins)
        np.testing.assert_allclose(found, position, atol=1e-9)


@settings(deadline=None, max_examples=25)
@given(S=st.floats(1.0, 10.0), share=st.floats(0.1, 1.0), amplitude=st.floats(1.05, 3.0))
def test_a_valve_that_runs_on_is_choudhurys_flow_chart(S, share, amplitude):
    # a triangle: after each turn the valve waits for S, slips by J and then stays (S - J)/2 behind
    J, swing = share * S, amplitude * S
    u = swing / 2.0 * (2.0 / np.pi) * np.arcsin(np.sin(2.0 * np.pi * (np.arange(2000) + 0.5) / 500.0))
    x = valve_position(u, START, 0.5 * (S + J), 0.5 * (S - J), True, 0.0)
    late = slice(600, None)
    jumps = np.abs(np.diff(x[late]))
    step = float(np.abs(np.diff(u)).max())
    assert np.all((jumps < 1.5 * step) | (np.abs(jumps - J) < 2.5 * step))
    moving = jumps > 1e-12
    behind = np.abs(u[late] - x[late])[1:]
    np.testing.assert_allclose(behind[moving], 0.5 * (S - J), atol=1e-9)


@pytest.mark.parametrize("kind", ["stiction", "outside"])
def test_units_and_signs_change_nothing_but_the_bands_unit(kind):
    recording = loop_of(kind, valve="choudhury", S=6.0, J=4.0) if kind == "stiction" else loop_of(kind)
    turned = replace(
        recording, u=0.1 * recording.u - 3.0, y=-40.0 * recording.y + 7.0, extra={"r": -40.0 * recording["r"] + 7.0}
    )
    first, second = diagnosed(kind), diagnose_routine([turned])
    assert second.verdict == first.verdict
    if first.band is not None:
        assert second.band is not None
        assert second.band.value == pytest.approx(0.1 * first.band.value, rel=0.02)


@pytest.mark.parametrize("time", [1e-3, 60.0])
def test_the_unit_of_time_changes_nothing_but_the_period(time: float) -> None:
    recording = loop_of("stiction", valve="choudhury", S=6.0, J=4.0)
    first, second = diagnosed("stiction"), diagnose_routine([replace(recording, t=time * recording.t)])
    assert second.verdict == first.verdict
    assert second.valves.decrease == pytest.approx(first.valves.decrease, abs=1e-9)
    assert second.oscillation.period_s == pytest.approx(time * first.oscillation.period_s)


def test_readings_that_are_missing_do_not_change_the_verdict():
    recording = loop_of("stiction", valve="choudhury", S=6.0, J=4.0)
    y = recording.y.copy()
    y[200:230], y[700::97] = np.nan, np.nan
    assert diagnose_routine([replace(recording, y=y)]).faulty


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), period=st.floats(12.0, 40.0))
@example(seed=118, period=32.0)  # the largest swings 11 % off the band's middle
def test_a_sine_keeps_its_phase_and_ringing_noise_loses_it(seed, period):
    random = np.random.default_rng(seed)
    n = 2000
    steady = np.sin(2.0 * np.pi * np.arange(n) / period) + 0.2 * random.normal(size=n)
    pole = np.exp((-0.03 + 1j) * 2.0 * np.pi / period)
    ringing = np.empty(n)
    state = 0.0 + 0.0j
    for k in range(n):
        state = pole * state + random.normal()
        ringing[k] = state.imag
    for y, lasts in ((steady, True), (ringing, False)):
        record = Recording(t=np.arange(n, dtype=float), u=np.roll(y, 3), y=y)
        share, periods = phase_kept(operation_of([record], LIMITS))
        assert (share > LIMITS.least_phase) == lasts
        # noise that rings has a band of frequencies, and its largest swings may lie anywhere in it
        assert periods == pytest.approx(n / period, rel=0.02 if lasts else 0.3)


def test_a_sine_is_regular_and_white_noise_is_not():
    n = 1500
    noise = np.random.default_rng(3).normal(size=n)
    assert regularity(np.sin(2.0 * np.pi * np.arange(n) / 37.0) + 0.1 * noise) > 3.0
    assert regularity(noise) < 1.0


def test_a_set_point_at_rest_has_no_answer():
    assert setpoint_answer(operation_of([loop_of("quiet")], LIMITS), 0.1) is None


def test_every_threshold_has_a_unit_a_meaning_and_an_origin():
    assert all(unit and meaning and origin for _, _, unit, meaning, origin in table(LIMITS))


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4, 6, 7])
@pytest.mark.parametrize("family", ["linear loop", "linear loop, limited"])
def test_no_valve_is_blamed_in_a_linear_loop(family, seed):
    assert not diagnose_routine([surrogate(family, seed)]).faulty


@pytest.mark.parametrize("seed", [*range(0, 100, 5), 9031])
def test_no_valve_is_blamed_whatever_drives_a_linear_loop(seed):
    """Seed 9031 of a limited loop: its valve was blamed for 22 % less error, of which chance brings 15 %."""
    drawn = linear_loop(seed)
    t = drawn.dt_s * np.arange(drawn.u.size)
    records = [Recording(t=t, u=drawn.u, y=drawn.y)] if seed < 100 else [surrogate("linear loop, limited", seed)]
    assert not diagnose_routine(records).faulty


@pytest.mark.parametrize(
    ("shape", "seed"),
    [
        ("square", 3), ("triangle", 5), ("square", 5), ("saw", 5), ("triangle", 7), ("square", 7), ("square", 9),
        ("square", 11), ("square", 13),
    ],
)  # fmt: skip
def test_another_loop_that_swings_this_one_is_not_laid_to_its_valve(shape: Shape, seed: int) -> None:
    """A load that is no sine: the position of a faulty valve foretells it, and so does that of a period ago."""
    found = diagnose_routine([recorded(swung_from_outside(shape, seed, wanders=False))])
    assert found.verdict in ("outside_oscillation", "none", "abstain")


def test_a_valve_is_found_where_the_command_knows_more_of_y_than_the_rows_show():
    """A fast controller, of which a historian kept means: the command knows what y was between them."""
    assert diagnose_routine([recorded(valve_case("play", 9002))]).faulty


@pytest.mark.parametrize("seed", [0, 1, 3, 4])
def test_the_digits_of_a_file_do_not_change_what_is_said(seed):
    recording = surrogate("linear loop", seed)
    said = set()
    for digits in (10, 8, 6):
        u, y = (np.array([float(f"{x:.{digits}g}") for x in signal]) for signal in (recording.u, recording.y))
        found = diagnose_routine([replace(recording, u=u, y=y)])
        said.add(found.verdict)
    assert len(said) == 1, said


def test_a_chance_of_a_quarter_comes_up_in_a_quarter_of_linear_loops():
    limits = replace(LIMITS, resamplings=99)
    loops = [operation_of([surrogate("linear loop", seed)], limits) for seed in range(40000, 40060) if seed % 3 != 2]
    chances = np.array([compare_valves(loop, limits).chance for loop in loops])
    for level in (0.05, 0.25, 0.5):  # four standard deviations beside the mean
        spread = np.sqrt(level * (1.0 - level) * chances.size)
        assert abs(np.sum(chances <= level) - level * chances.size) <= 4.0 * spread
    assert np.sum(chances <= LIMITS.chance) <= 2


@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_a_sine_from_outside_is_not_laid_to_the_valve(seed):
    found = diagnose_routine([loop_of("outside", seed=seed)])
    assert found.verdict == "outside_oscillation"
    assert found.valves.decrease < 0.1


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), period=st.floats(12.0, 60.0))
def test_the_period_of_a_line_between_two_of_the_spectrums_grid_is_found(seed, period):
    noise = np.random.default_rng(seed).normal(size=(2, 1000))
    angle = 2.0 * np.pi * np.arange(1000) / period
    record = Recording(t=np.arange(1000.0), u=np.sin(angle) + 0.1 * noise[0], y=np.cos(angle) + 0.1 * noise[1])
    found = operation_of([record], LIMITS).period_rows
    assert abs(1000.0 / found - 1000.0 / period) < 0.02  # of a turn over the whole record


def test_readings_that_are_missing_at_regular_times_are_held():
    recording = loop_of("stiction", valve="choudhury", S=6.0, J=4.0)
    y = recording.y.copy()
    y[::5] = np.nan
    assert diagnose_routine([replace(recording, y=y)]).faulty


def refused(**changed: np.ndarray) -> str:
    recording = loop_of("quiet", rows=300)
    with pytest.raises(InputError) as error:
        diagnose_routine([replace(recording, **changed)])
    return str(error.value)


def test_a_record_that_nothing_can_be_learnt_from_is_refused_with_its_reason():
    n = 300
    assert "u is constant" in refused(u=np.full(n, 40.0))
    gap = loop_of("quiet", rows=n).u.copy()
    gap[50] = np.nan
    assert "u is missing in 1 row(s), first at t = 50 s" in refused(u=gap)
    calm = loop_of("quiet", rows=n)
    few = np.full(n, np.nan)
    assert "y has no reading" in refused(y=few)
    few[100:120] = calm.y[100:120]
    assert "y can be predicted in" in refused(y=few)
    assert "y is constant (3)" in refused(y=np.full(n, 3.0))
    assert "values up to 1e+160" in refused(u=1e160 * calm.u / np.max(np.abs(calm.u)))
    with pytest.raises(InputError, match="40 rows"):
        diagnose_routine([loop_of("quiet", rows=40)])
    slow = loop_of("quiet", rows=n)
    with pytest.raises(InputError, match="sample times of 1 s and 2 s"):
        diagnose_routine([slow, replace(slow, t=2.0 * slow.t)])


def test_a_long_record_is_looked_at_where_the_command_travels_furthest_and_says_so():
    calm = loop_of("quiet", rows=9000)
    u = calm.u.copy()
    u[4000:] += 5.0 * np.sin(2.0 * np.pi * np.arange(5000) / 20.0)
    operation = operation_of([replace(calm, u=u)], replace(LIMITS, most_rows=2000))
    assert operation.dt_s == 1.0  # no coarser than the oscillation needs
    assert operation.u.size == 2000
    assert np.ptp(operation.u[:100]) > 8.0
    assert operation.seen == pytest.approx(2000 / 9000, rel=0.01)


def test_the_command_writes_what_was_found_and_a_page(tmp_path):
    write_recording(loop_of("stiction", valve="choudhury", S=6.0, J=4.0), tmp_path / "flow.csv")
    done = CliRunner().invoke(
        app, ["diagnose", "--routine", str(tmp_path / "flow.csv"), "--out", str(tmp_path / "out")]
    )
    assert done.exit_code == 0, done.output
    content = json.loads((tmp_path / "out/routine.json").read_text())
    assert content["schema"] == 2
    assert content["verdict"] in ("stiction", "backlash")
    assert content["valve"]["band"]["low"] <= content["valve"]["band"]["value"] <= content["valve"]["band"]["high"]
    assert content["sentences"][0] in done.output
    assert "Evidence, slip by slip" in (tmp_path / "out/report.html").read_text()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--routine", "--model", "m.toml"], "it does not go with --routine"),
        ([], "--routine for a loop in operation that has no model"),
    ],
)
def test_a_model_and_a_routine_record_exclude_each_other(tmp_path, options, says):
    write_recording(loop_of("quiet", rows=300), tmp_path / "flow.csv")
    done = CliRunner().invoke(
        app, ["diagnose", str(tmp_path / "flow.csv"), "--out", str(tmp_path / "out"), *options], standalone_mode=False
    )
    assert isinstance(done.exception, InputError)
    assert done.exception.exit_status == 2
    assert says in str(done.exception)
    assert not (tmp_path / "out").exists()


#: Recordings of industrial loops beside the checkout: what their data base says of the valve.
INDUSTRIAL = [
    ("p_07", ("fit",), True),
    ("p_12", ("test",), False),
    pytest.param("p_07", ("test",), True, marks=pytest.mark.slow),
    pytest.param("p_10", ("fit", "test"), True, marks=pytest.mark.slow),
    pytest.param("p_12", ("fit",), False, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "parts", "faulty"), INDUSTRIAL)
def test_industrial_loops_are_told_as_their_data_base_labels_them(shared: Path, name, parts, faulty):
    folder = shared / "real_cases" / name
    if not folder.exists():
        pytest.skip(f"no recordings at {folder}")
    found = diagnose_routine([read_recording(folder / f"{part}.csv") for part in parts])
    assert found.faulty == faulty
    assert found.verdict in ("stiction", "backlash", "none", "abstain")


@pytest.mark.parametrize("kind", ["steps", "wandering"])
def test_nothing_is_claimed_of_a_valve_that_follows(kind: CaseKind):
    case = valve_case(kind, 11, 900)
    record = Recording(t=case.dt_s * np.arange(900.0), u=case.u, y=case.y, extra={"r": case.r})
    assert diagnose_routine([record]).verdict in ("none", "abstain", "outside_oscillation")


@pytest.mark.parametrize("seed", [6, 57, 66, 122, 182])
def test_a_valve_that_hardly_turned_is_not_blamed(seed: int) -> None:
    """Two random walks without a relation: the valve that explains most spans nearly all of u, and rests."""
    found = diagnose_routine([surrogate("random walk", seed)])
    assert found.valves.reversals < 6
    assert not found.faulty


@pytest.mark.parametrize("seed", [39, 66, 120, 142])
def test_exchanged_columns_are_said_first(seed: int) -> None:
    exchanged = surrogate("swapped", seed)
    diagnose_routine([replace(exchanged, u=exchanged.y, y=exchanged.u)])
    with pytest.raises(IdentificationError, match="u and y seem swapped"):
        diagnose_routine([exchanged])
