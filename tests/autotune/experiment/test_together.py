"""A sweep whose points are estimated together: when that is done, when it is refused, and what is kept of it."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from autotune.errors import ExperimentStopped, OperatorStop
from autotune.experiment.cycles import read_earlier
from autotune.experiment.dwell import Dwell, further_periods
from autotune.experiment.local_model import LocalModel
from autotune.experiment.oscillation import Oscillation
from autotune.experiment.plan import phase_targets
from autotune.experiment.result import ExperimentResult, Status
from autotune.experiment.run import run_experiment
from autotune.experiment.sweep import missing_phases
from autotune.experiment.together import WORTH, Found
from autotune.identification.envelope import polar_sd
from autotune.identification.frequency.recorded import session_points
from autotune.identification.sweep_estimate import SweepEstimate
from autotune.pipeline.measured import measure_plant
from autotune.pipeline.swept import price_of
from autotune.recording import read_recording
from drivers.simulated import SimulatedRig
from sim.ball import make_ball
from tests.autotune.experiment.rigs import EACH, ball_config, ball_rig
from tests.benchmarks._joint_plants import CASES, LinearPlant
from tests.sim.imperfections import Fault, FaultyPlant

SAMPLE_S = 0.01


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[ExperimentResult, Path]:
    path = tmp_path_factory.mktemp("together") / "recording.csv"
    return run_experiment(ball_rig(seed=7), ball_config(), path), path


def test_all_points_are_known_as_well_as_is_wanted_in_half_the_time(
    swept: tuple[ExperimentResult, Path], tmp_path: Path
) -> None:
    result, _ = swept
    each = run_experiment(ball_rig(seed=7), ball_config(**EACH), tmp_path / "each.csv")
    wanted = ball_config().experiment
    assert result.together is not None
    assert len(result.points) == len(each.points) == wanted.points
    assert result.sweep_time_s < 0.6 * each.sweep_time_s
    for gain_sd, phase_sd in map(polar_sd, result.points):
        assert max(gain_sd, math.degrees(phase_sd) / 100.0) <= wanted.gain_sd
    targets = phase_targets(*wanted.phases_deg, wanted.points)
    reached = sorted(float(np.angle(-point.response)) for point in result.points)
    assert reached == pytest.approx(targets, abs=math.radians(5.0))


@pytest.mark.parametrize("price", [0.0, math.inf])
def test_a_sweep_for_a_controller_goes_on_while_the_rest_of_its_budget_is_worth_it(
    tmp_path: Path, price: float
) -> None:
    # a gain_sd that three cycles never reach: it is not asked where a price is known
    wanted = {"goal": "controller", "gain_sd": 1e-5, "budget_s": 40.0}
    path = tmp_path / "recording.csv"
    result = run_experiment(ball_rig(seed=3), ball_config(experiment=wanted), path, price=lambda *_: price)
    assert result.together is not None
    assert (len(result.segments) > 3) is (price > 0.0)
    assert result.sweep_time_s <= 40.0


def test_the_price_of_what_is_not_known_falls_with_it(swept: tuple[ExperimentResult, Path]) -> None:
    estimate = swept[0].together
    assert estimate is not None
    config = ball_config(experiment={"goal": "controller"})
    price = price_of(config)
    assert price is not None
    assert price_of(ball_config()) is None
    fit = estimate.fit
    half, none = (replace(estimate, fit=replace(fit, covariance=k * fit.covariance)) for k in (0.25, 1e-12))
    whole, halved, known = (price(one, swept[0].noise_sd) for one in (estimate, half, none))
    assert whole > halved > 0.0
    assert known == pytest.approx(0.0, abs=2e-3)  # a design's tolerance


@given(price=st.floats(1e-6, 10.0), sd=st.floats(1e-5, 0.3), swept_s=st.floats(1.0, 59.0))
def test_what_is_wanted_is_what_the_rest_of_the_budget_is_worth(price: float, sd: float, swept_s: float) -> None:
    estimate = cast(SweepEstimate, SimpleNamespace(worst_sd=sd))
    wanted = Found(estimate=estimate, why="", price=price).wanted_sd(0.0, swept_s, 60.0)
    worth = price * (1.0 - math.sqrt(swept_s / 60.0))
    assert (wanted >= sd) is (worth <= WORTH) or worth == pytest.approx(WORTH)
    if wanted < sd:  # there, at what it costs then, the rest is worth just so much
        at_s = swept_s * (sd / wanted) ** 2
        assert price * wanted / sd * (1.0 - math.sqrt(at_s / 60.0)) == pytest.approx(WORTH)


def test_a_sweep_that_was_stopped_with_few_points_tells_of_the_plant_by_its_rows(tmp_path: Path) -> None:
    rig, path = ball_rig(seed=7), tmp_path / "stopped.csv"
    with pytest.raises(ExperimentStopped, match="time over"):
        run_experiment(rig, ball_config(limits={"time_s": 30.0}), path)
    found = measure_plant([read_recording(path)])
    assert len(found.points) < 3
    assert found.fit is not None
    omega = np.array([1.5, 2.5, 4.0])
    truth = make_ball(seed=7).response(omega)
    assert np.abs(found.fit.plant.response(omega) / truth - 1.0).max() < 0.08


def test_the_recording_gives_the_same_points_again_and_no_rig_is_needed(
    swept: tuple[ExperimentResult, Path], tmp_path: Path
) -> None:
    result, path = swept
    again = session_points([read_recording(path)])
    assert again.points == result.points
    assert again.fit is not None
    assert result.together is not None
    assert again.fit.plant == result.together.fit.plant
    earlier = read_earlier([path], SAMPLE_S)
    assert missing_phases(ball_config().experiment, earlier) == ()
    rig = ball_rig(seed=7)
    assert run_experiment(rig, ball_config(), tmp_path / "never.csv", earlier=earlier).points == result.points
    assert rig.clock.now() == 0.0


def test_a_recording_that_lost_a_cycle_is_not_taken_for_a_whole_sweep(
    swept: tuple[ExperimentResult, Path], tmp_path: Path
) -> None:
    _, path = swept
    lines = path.read_bytes().splitlines(keepends=True)
    (tmp_path / "recording.csv").write_bytes(b"".join(lines[: int(0.8 * len(lines))]))
    (tmp_path / "recording.toml").write_bytes(path.with_suffix(".toml").read_bytes())
    earlier = read_earlier([tmp_path / "recording.csv"], SAMPLE_S)
    assert missing_phases(ball_config().experiment, earlier)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> ExperimentResult:
    return run_experiment(ball_rig(seed=3), ball_config(), tmp_path_factory.mktemp("whole") / "whole.csv")


def test_a_sweep_that_ends_before_its_points_are_known_well_enough_goes_on_when_it_is_resumed(tmp_path: Path) -> None:
    """An estimate of its rows asks for a further cycle, in which it is stopped: those rows are no whole sweep."""

    def stop(status: Status) -> None:
        if status.message.endswith("deg again"):
            raise KeyboardInterrupt

    with pytest.raises(OperatorStop):
        run_experiment(ball_rig(seed=3), ball_config(), tmp_path / "begun.csv", on_status=stop)
    earlier = read_earlier([tmp_path / "begun.csv"], SAMPLE_S)
    assert len(earlier.segments) == 3
    assert missing_phases(ball_config().experiment, earlier)


@pytest.mark.parametrize("start_s", [16.0, 20.0, 24.0, 28.0])
@pytest.mark.parametrize("share", [0.85, 0.93])
def test_an_actuator_that_clips_in_mid_sweep_gives_no_points_of_all_rows_that_are_wrong(
    start_s: float, share: float, tmp_path: Path, whole: ExperimentResult
) -> None:
    hit = next((one for one in whole.segments if one.end_s > start_s), whole.segments[-1])
    level = hit.settings.midpoint + share * hit.settings.amplitude
    plant = FaultyPlant(make_ball(seed=3, noise=0.35), [Fault(kind="saturated actuator", start_s=start_s, value=level)])
    try:
        result = run_experiment(SimulatedRig(plant, u_safe=0.0), ball_config(), tmp_path / "clipped.csv")
    except ExperimentStopped:
        return
    if result.together is not None:
        truth = plant.response(np.array([point.omega_rad_s for point in result.points]))
        for point, expected in zip(result.points, truth, strict=True):
            assert abs(point.response / expected - 1.0) < 4.0 * ball_config().experiment.gain_sd
    else:
        assert result.by_itself


@pytest.mark.parametrize("violated", [{"play": 0.01}, {"curve": 0.15}])
def test_what_is_no_equation_gets_a_cycle_for_each_point(violated: dict[str, float], tmp_path: Path) -> None:
    case = replace(next(case for case in CASES if case.name == "lags 1 and 0.3, dead time 0.2"), **violated)
    rig = SimulatedRig(LinearPlant(case, seed=2), u_safe=5.0)
    told: list[Status] = []
    result = run_experiment(rig, case.config(together=True), tmp_path / "r.csv", on_status=told.append)
    assert result.together is None
    assert "the rows show " in result.by_itself
    assert any(result.by_itself in one.message for one in told)
    assert len({one.phase_rad for one in result.segments}) == len(result.points) == 5


def test_rows_that_were_refused_by_chance_give_all_points_once_there_are_more(tmp_path: Path) -> None:
    """Rows of the first three cycles deny the equation here, as one sweep in twenty does; those of all eight do not."""
    case = next(case for case in CASES if case.name == "tanks (1.0, 0.5, 0.2), dead time")
    plant = LinearPlant(replace(case, name=f"nothing: {case.name}"), seed=6)
    told: list[Status] = []
    result = run_experiment(
        SimulatedRig(plant, u_safe=5.0), case.config(together=True), tmp_path / "r.csv", on_status=told.append
    )
    assert any("each point by itself: the rows show " in one.message for one in told)
    assert result.together is not None
    assert not result.by_itself
    assert result.together.refused(look=2) == ""
    assert len(result.segments) > len(result.points) == 5
    assert session_points([read_recording(tmp_path / "r.csv")]).points == result.points
    for point in result.points:
        miss = point.response - plant.response(np.array([point.omega_rad_s]))[0]
        parts = np.array([miss.real, miss.imag])
        assert parts @ np.linalg.solve(np.array(point.covariance), parts) < chi2.ppf(0.9999, 2)


@pytest.mark.parametrize("name", ["inverse response 0.3", "resonance at 5, damping 0.1", "oscillating"])
def test_zeros_and_poles_that_ring_are_equations_too(name: str, tmp_path: Path) -> None:
    case = next(case for case in CASES if case.name == name)
    plant = LinearPlant(case, seed=2)
    result = run_experiment(SimulatedRig(plant, u_safe=5.0), case.config(together=True), tmp_path / "r.csv")
    assert result.together is not None
    for point in result.points:
        miss = point.response - plant.response(np.array([point.omega_rad_s]))[0]
        parts = np.array([miss.real, miss.imag])
        assert parts @ np.linalg.solve(np.array(point.covariance), parts) < chi2.ppf(0.9999, 2)


def test_a_cycle_too_short_for_a_point_of_its_own_still_tells_of_the_plant(tmp_path: Path) -> None:
    case = next(case for case in CASES if case.name == "lag, dead time 1")
    rig = SimulatedRig(LinearPlant(case, seed=1), u_safe=5.0)
    result = run_experiment(rig, case.config(together=True), tmp_path / "r.csv")
    assert result.together is not None
    assert session_points([read_recording(tmp_path / "r.csv")]).points == result.points


def test_a_load_step_in_the_sweep_is_told_and_sends_it_to_cycles_of_their_own(tmp_path: Path) -> None:
    case = next(case for case in CASES if case.name == "integrator, lag 1, dead time 0.05")
    case = replace(case, load=0.006, load_s=8.0 * case.time_s)
    result = run_experiment(
        SimulatedRig(LinearPlant(case, seed=1), u_safe=5.0), case.config(together=True), tmp_path / "r.csv"
    )
    assert result.together is None
    assert "a drift or a load" in result.by_itself


class GoingOn(SimulatedRig):
    """A simulated rig whose clock says that time goes on: the estimate runs beside the loop.

    Meanwhile a row takes as long as on a real rig. A loop as fast as the processor would keep it from the estimate, and
    go through hours of rig time.
    """

    def __init__(self, seed: int) -> None:
        super().__init__(FaultyPlant(make_ball(seed=seed, noise=0.35), []), u_safe=0.0)
        self.clock.goes_on = True  # type: ignore[attr-defined]
        self.beside = 0

    def write(self, u: float) -> None:
        super().write(u)
        for thread in threading.enumerate():
            if thread.name == "estimate of the sweep":
                self.beside += 1
                thread.join(SAMPLE_S)


def test_the_relay_goes_on_while_the_estimate_runs_beside_it(tmp_path: Path) -> None:
    rig = GoingOn(seed=7)
    patient = ball_config(limits={"time_s": 1e4})  # how long an estimate takes depends on the processor
    result = run_experiment(rig, patient, tmp_path / "r.csv")
    assert rig.beside > 0
    assert len(result.points) == 5
    assert np.abs(read_recording(tmp_path / "r.csv").between(result.segments[0].start_s, 1e9).y - 5.0).max() < 3.4


@pytest.mark.parametrize("rows", [150, 200, 300, 450])
def test_whenever_an_estimate_ends_the_next_cycle_keeps_within_the_swing(
    rows: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse_after(oscillation: Oscillation, *_: object) -> Found:
        for _ in range(rows):  # of a slow cycle's 590
            oscillation.step()
        return Found(estimate=None, why="so long the estimate takes")

    monkeypatch.setattr("autotune.experiment.sweep_run.estimate_beside", refuse_after)
    result = run_experiment(ball_rig(seed=7), ball_config(limits={"time_s": 1e4}), tmp_path / "r.csv")
    assert len(result.points) == 5
    rows_of_it = read_recording(tmp_path / "r.csv").between(result.segments[0].start_s, 1e9)
    assert np.abs(rows_of_it.y - 5.0).max() < 3.4


def test_the_dwell_goes_where_a_period_tells_most() -> None:
    model = LocalModel(k=60.0, tau_s=0.36)
    omegas = (4.35, 2.36, 1.1)
    run = [Dwell(omega_rad_s=omega, signal=13.0, periods=2) for omega in omegas]
    half = further_periods(run, run, model, 0.01, factor=0.5, left_s=1e4)
    more = further_periods(run, run, model, 0.01, factor=0.25, left_s=1e4)
    assert sum(count * one.period_s for count, one in zip(more, run, strict=True)) > sum(
        count * one.period_s for count, one in zip(half, run, strict=True)
    )
    assert further_periods(run, run, model, 0.01, factor=1.0, left_s=1e4) == (0, 0, 0)
    assert further_periods(run, run, model, 0.01, factor=0.5, left_s=1.0) == (0, 0, 0)
    assert half[0] > 0  # the short periods of the fast end come cheap
