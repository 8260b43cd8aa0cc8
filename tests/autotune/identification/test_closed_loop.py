"""A person's recording of a loop: verdicts, refusals, files."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter
from typer.testing import CliRunner

from autotune.arrays import FloatArray
from autotune.cli import app
from autotune.controller import DiscreteController, PIDController, write_controller
from autotune.errors import IdentificationError, InputError
from autotune.identification.closed_loop.control_law import check_law
from autotune.identification.closed_loop.dither_proposal import DitherLimits, dwell_spectrum
from autotune.identification.closed_loop.identify import identify_closed_loop
from autotune.points import read_points
from autotune.recording import Recording, write_recording
from tests.loop_example import CONTROLLER_DEN, CONTROLLER_NUM, PLANT, PLANT_DEN, PLANT_NUM, example_set

DT = 0.05
LAW = PIDController(K=-0.023, Ti_s=3.0)


def ball_loop(
    *,
    rows: int = 3000,
    noise: float = 0.05,
    period: int = 100,
    dither: float = 0.0,
    seed: int = 0,
    gain: float = 1.0,
    added: FloatArray | None = None,
) -> Recording:
    """Return a recording of -65.5/(s (0.3836 s + 1)) under its PI, set-point steps about 5, command about 5."""
    rng = np.random.default_rng(seed)
    num, den, _ = cont2discrete(([-65.5], [0.3836, 1.0, 0.0]), DT, "zoh")
    b, a = np.ravel(num), den
    x, u, y = np.zeros(rows + 2), np.zeros(rows + 2), np.zeros(rows)
    r = 5.0 + np.where((np.arange(rows) // max(period, 1)) % 2 == 1, 0.5, -0.5) * (period > 0)
    if added is None:
        added = dither * (2.0 * rng.integers(0, 2, rows) - 1.0)
    integral = 0.0
    for t in range(rows):
        x[t + 2] = b[1] * u[t + 1] + b[2] * u[t] - a[1] * x[t + 1] - a[2] * x[t]
        y[t] = 5.0 + x[t + 2] + noise * rng.standard_normal()
        error = r[t] - y[t]
        integral += gain * LAW.K * DT / LAW.Ti_s * error
        u[t + 2] = gain * LAW.K * error + integral + added[t]
    extra = {"r": r} | ({"dither": added} if np.any(added) else {})
    return Recording(t=DT * np.arange(rows), u=5.0 + u[2:], y=y, extra=extra)


def without_r(recording: Recording) -> Recording:
    return Recording(t=recording.t, u=recording.u, y=recording.y)


def test_integrating_rig_under_its_pi_gives_the_plants_own_points() -> None:
    found = identify_closed_loop(ball_loop(), controller=LAW)
    assert found.estimate.model.order == 2
    assert found.law is not None
    assert found.law.summation == "set-point"
    assert found.law.unexplained < 1e-9
    near = [point for point in found.points if 0.5 < point.omega_rad_s < 6.0]
    assert len(near) > 5
    for point in near:
        s = 1j * point.omega_rad_s
        truth = -65.5 / (s * (0.3836 * s + 1.0))  # continuous: the command's hold is taken out
        assert abs(point.response / truth - 1.0) < 0.02
    assert found.excitation.enough
    assert found.excitation.critical == "gain crossover"
    assert found.excitation.band_rad_s[0] < 1.384 < found.excitation.band_rad_s[1]


def test_points_for_a_design_are_no_more_than_the_model_determines() -> None:
    found = identify_closed_loop(ball_loop(), order=2)
    assert len(found.design_points) == 3
    critical = 1.0 / 0.3836  # the phase of -90 - atan(0.3836 w) is -135 degrees there
    omega = [point.omega_rad_s for point in found.design_points]
    assert omega[0] == pytest.approx(critical / 3.0, rel=0.2)
    assert omega[-1] == pytest.approx(critical * 2.0, rel=0.2)


def test_response_is_that_of_the_polynomials() -> None:
    found = identify_closed_loop(ball_loop(), order=2)
    num, den = found.estimate.model.polynomials()
    controller_form = DiscreteController(num=tuple(num), den=tuple(den), sample_time_s=DT)
    omega = np.array([point.omega_rad_s for point in found.response])
    np.testing.assert_allclose([p.response for p in found.response], controller_form.response(omega), rtol=1e-6)


def test_noise_free_recording_is_identified_to_rounding() -> None:
    found = identify_closed_loop(ball_loop(noise=0.0))
    assert found.estimate.model.order == 2
    np.testing.assert_allclose(sorted(found.poles.real), [math.exp(-DT / 0.3836), 1.0], atol=1e-6)


def test_loop_moved_by_feedback_alone_is_refused_and_says_why() -> None:
    still = ball_loop(period=0)
    with pytest.raises(IdentificationError, match=r"not persistently exciting.*r was recorded and did not move"):
        identify_closed_loop(still)
    with pytest.raises(IdentificationError, match="r was not recorded"):
        identify_closed_loop(without_r(still))


def test_record_too_short_to_tell_noise_from_drift_says_that_its_regions_are_too_small() -> None:
    short, long = (ball_loop(rows=rows, noise=0.2, dither=0.0125, period=0, seed=9) for rows in (300, 3000))
    said = "takes out more trends"
    assert any(said in warning for warning in identify_closed_loop(short, order=2).warnings)
    assert not any(said in warning for warning in identify_closed_loop(long, order=2).warnings)


def test_missing_r_is_said_where_the_command_is_rich_enough() -> None:
    found = identify_closed_loop(without_r(ball_loop(period=0, dither=0.02)), order=2)
    assert any("r was not recorded" in warning for warning in found.warnings)
    near = [point for point in found.points if 2.0 < point.omega_rad_s < 10.0]
    for point in near:
        s = 1j * point.omega_rad_s
        assert abs(point.response * s * (0.3836 * s + 1.0) / -65.5 - 1.0) < 0.25


def test_poor_excitation_says_how_much_more_is_needed() -> None:
    weak, strong = (identify_closed_loop(ball_loop(period=0, dither=a), order=2) for a in (0.002, 0.02))
    assert not weak.excitation.enough
    assert "not excited enough" in weak.excitation.sentence
    assert weak.excitation.length_factor == pytest.approx(weak.excitation.amplitude_factor**2)
    assert strong.excitation.relative_sd < weak.excitation.relative_sd / 3.0


def binary(dwell_s: tuple[float, float], rows: int, seed: int) -> FloatArray:
    """Return +-1 with dwell times log-uniform between two bounds."""
    rng = np.random.default_rng(seed)
    dwells = np.exp(rng.uniform(*np.log(dwell_s), rows)) / DT
    switches = np.searchsorted(np.cumsum(dwells), np.arange(rows), side="right")
    return np.where(switches % 2 == 0, 1.0, -1.0)


@pytest.mark.parametrize("law", [None, LAW])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_proposed_dither_is_enough_when_it_is_run(seed: int, law: PIDController | None) -> None:
    weak = identify_closed_loop(ball_loop(period=0, dither=0.0015, seed=seed), order=2, controller=law)
    proposal = weak.proposal
    assert proposal is not None
    rows = round(proposal.length_s / DT)
    added = proposal.amplitude * binary(proposal.dwell_s, rows, seed + 100)
    recording = ball_loop(rows=rows, period=0, seed=seed + 50, added=added)
    found = identify_closed_loop(recording, order=2, controller=law)
    # the weak record does not know the plant better than to some 10 %, nor its critical frequency
    assert 0.015 < found.excitation.relative_sd < 0.06
    noise = 0.06  # of the loop without a dither
    assert np.std(recording.y) < 1.3 * math.hypot(proposal.departure / 3.0, noise)


def test_spectrum_of_the_proposed_dither_is_that_of_its_signal() -> None:
    rows, segment = 2**17, 2**10
    signal = binary((0.4, 3.0), rows, 5).reshape(-1, segment)
    omega = 2.0 * math.pi * np.arange(1, 60) / (segment * DT)
    window = np.hanning(segment)
    power = np.mean(np.abs(np.fft.rfft(signal * window, axis=1)) ** 2, axis=0)[1:60] * DT / np.sum(window**2)
    ratio = dwell_spectrum(omega, 0.4, 3.0)[3:] / power[3:]
    assert np.mean(np.abs(np.log(ratio))) < 0.12
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.08)


def test_proposal_keeps_the_limits_it_is_given() -> None:
    recording = ball_loop(period=0, dither=0.0015)
    tight = DitherLimits(amplitude=0.001, departure=10.0, source="the rig's limits")
    by_u = identify_closed_loop(recording, order=2, limits=tight).proposal
    by_y = identify_closed_loop(
        recording, order=2, limits=DitherLimits(amplitude=1.0, departure=0.05, source="the rig's limits")
    ).proposal
    assert by_u is not None
    assert by_y is not None
    assert by_u.amplitude == pytest.approx(0.001)
    assert by_y.departure == pytest.approx(0.05)
    energies = [p.amplitude**2 * p.length_s for p in (by_u, by_y)]
    assert energies[0] == pytest.approx(energies[1])  # half the amplitude takes four times as long
    assert "the rig's limits" in by_u.sentence


def test_controller_that_contradicts_the_data_is_refused_with_the_gain_that_would_fit() -> None:
    with pytest.raises(InputError, match=r"contradicts the data.*gain 1\.5"):
        identify_closed_loop(ball_loop(gain=1.5), controller=LAW)


def test_converter_that_rounds_the_command_does_not_contradict_the_law() -> None:
    right, wrong = (ball_loop(gain=gain) for gain in (1.0, 1.5))
    law = check_law(LAW, np.round(right.u / 0.002) * 0.002, right.y, right["r"], DT)
    assert law.unexplained > 0.2  # a step of the converter is two thirds of the law's rms step
    assert law.beyond_rounding < 0.06
    law = check_law(LAW, np.round(wrong.u / 0.002) * 0.002, wrong.y, wrong["r"], DT)
    assert law.contradicts
    assert law.gain_ratio == pytest.approx(1.5, rel=0.02)


def test_additive_excitation_is_recognised() -> None:
    d = example_set(3)
    law = DiscreteController(num=tuple(CONTROLLER_NUM), den=tuple(CONTROLLER_DEN), sample_time_s=1.0)
    check = check_law(law, d.u[:, 0], d.y[:, 0], d.r[:, 0], 1.0)
    assert check.summation == "command"
    assert check.unexplained < 1e-6


def test_dither_column_belongs_to_the_law() -> None:
    recording = ball_loop(dither=0.02)
    check = check_law(LAW, recording.u, recording.y, recording["r"], DT, added=recording["dither"])
    assert check.unexplained < 1e-9
    assert check_law(LAW, recording.u, recording.y, recording["r"], DT).contradicts


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda r: Recording(t=r.t[:40], u=r.u[:40], y=r.y[:40]), "too short: 40 equidistant rows"),
        (lambda r: Recording(t=r.t, u=np.full_like(r.u, 5.0), y=r.y), "u does not move"),
        (lambda r: Recording(t=r.t, u=r.u, y=np.zeros_like(r.y)), "y does not move"),
        (lambda r: Recording(t=r.t, u=r.u, y=np.where(np.arange(len(r)) % 10 == 0, np.nan, r.y)), "not numbers"),
    ],
)
def test_unusable_recordings_are_refused_by_name(spoil: Callable[[Recording], Recording], message: str) -> None:
    with pytest.raises(InputError, match=message):
        identify_closed_loop(spoil(ball_loop()))


def test_sound_stretches_are_used_and_what_is_left_out_is_named() -> None:
    whole = ball_loop()
    rows = np.arange(len(whole))
    t = whole.t + np.where(rows > 700, 0.4, 0.0)
    y = np.where((rows == 2900) | (rows >= 2980), np.nan, whole.y)
    found = identify_closed_loop(Recording(t=t, u=whole.u, y=y, extra=whole.extra), order=2)
    assert found.warnings[0] == "2 stretches between gaps are used together"
    assert any("1 of 2980 rows" in warning for warning in found.warnings)  # put in
    assert any("2980 of 3000 rows are used" in warning for warning in found.warnings)
    assert max(abs(np.sort(found.poles.real) - [math.exp(-DT / 0.3836), 1.0])) < 0.01


def test_command_writes_the_fixed_format(tmp_path: Path) -> None:
    d = example_set(4)
    columns = {"u": d.u[:, 0], "y": d.y[:, 0], "r": d.r[:, 0]}
    t = 0.1 * np.arange(len(d.u))
    write_recording(Recording(t=t, u=columns["u"], y=columns["y"], extra={"r": columns["r"]}), tmp_path / "rec.csv")
    law = DiscreteController(num=tuple(CONTROLLER_NUM), den=tuple(CONTROLLER_DEN), sample_time_s=0.1)
    write_controller(law, tmp_path / "c.toml")
    out = tmp_path / "closed_loop.json"
    arguments = ["identify", "closed-loop", str(tmp_path / "rec.csv"), "--order", "5", "--out", str(out)]
    result = CliRunner().invoke(app, [*arguments, "--controller", str(tmp_path / "c.toml")])
    assert result.exit_code == 0, result.output
    content = json.loads(out.read_text())
    assert content["order"] == 5
    assert content["sample_time_s"] == pytest.approx(0.1)
    assert content["den"][0] == 1.0
    assert len(content["den"]) == 6
    assert content["num"][0] == 0.0  # y is measured before its row's u acts
    np.testing.assert_allclose(content["den"], PLANT_DEN, atol=0.3)
    assert content["noise_variance"] == pytest.approx(1.0 / 9.0, rel=0.15)
    poles = [complex(*pole) for pole in content["poles"]]
    assert max(abs(pole - PLANT.poles[np.argmin(abs(PLANT.poles - pole))]) for pole in poles) < 0.1
    assert {"omega_rad_s", "gain", "phase_deg", "cov"} <= set(content["response"][0])
    assert all(point.gain > 0 for point in read_points(out))  # the same file serves autotune design --points


def test_filter_of_the_example_agrees_with_its_state_space() -> None:
    impulse = np.eye(1, 12)[0]
    np.testing.assert_allclose(lfilter(PLANT_NUM, PLANT_DEN, impulse), PLANT.markov_parameters(12)[:, 0, 0], atol=1e-12)
