"""What a page says a loop will do is what its plant and controller do, and the plant runs over its recordings."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.config.procedure import DesignSettings, SignalSettings
from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.noise import LoopFacts
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction
from autotune.pipeline.analysis import Analysis, analyse
from autotune.points import FrequencyPoint
from autotune.recording import Recording
from autotune.report.analysis_sections import analysis_sections
from autotune.report.outlook import APART, outlook_section, outlook_sentences
from autotune.report.plant_section import model_figures, numbers_table
from autotune.report.points_section import frequency_grid, points_section

SIGNALS = SignalSettings(sample_time_s=0.1, u_unit="%", y_unit="degC")


def known(plant: TransferFunction, spread: float = 0.0) -> PlantFit:
    """Return a fit of one lag with a dead time whose gain and lag are known to a share."""
    gain, lag = plant.num[-1], plant.den[-2]

    def build(x: np.ndarray) -> TransferFunction:
        return TransferFunction(num=(math.exp(x[0]),), den=(math.exp(x[1]), 1.0), delay_s=plant.delay_s)

    x = np.log([gain, lag])
    return PlantFit(
        plant=plant, integrating=False, parameters=x, covariance=spread**2 * np.eye(2), sign=1, chi_square=0.0,
        degrees_of_freedom=0, bounds=np.array([x - 5.0, x + 5.0]), build=build, source="recording",
    )  # fmt: skip


OVEN = TransferFunction(num=(0.8,), den=(90.0, 1.0), delay_s=8.0)


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    facts = LoopFacts(noise_sd=0.05, u_span=20.0, sample_time_s=0.1)
    return analyse((), DesignSettings(noise_gain=50.0), fit=known(OVEN, 0.03), facts=facts)


def test_a_recordings_points_are_designed_on_where_they_are_asked_for(analysis: Analysis) -> None:
    assert analysis.source == "fitted plant"
    assert "--source points" in str(dict(analysis.alternatives)["points"])


def test_the_predicted_steps_are_those_of_the_continuous_loop(analysis: Analysis) -> None:
    (section,) = outlook_section(analysis, SIGNALS)
    row = next(row for row in section.tables[0].rows if row[0] == "designed")
    c, s = analysis.controller, control.tf("s")
    num, den = control.pade(OVEN.delay_s, 12)
    plant = control.tf([0.8], [90.0, 1.0]) * control.tf(num, den)
    law = c.K * (1 + 1 / (c.Ti_s * s)) / (c.Tf_s * s + 1)
    t = np.linspace(0.0, 40.0 * c.Ti_s, 8000)
    _, y = control.step_response(control.feedback(plant * law, 1), t)
    _, load = control.step_response(c.K * control.feedback(plant, law), t)
    assert float(str(row[5]).split()[0]) == pytest.approx(100.0 * (y.max() - 1.0), abs=2.0)
    assert float(str(row[6])) == pytest.approx(load.max(), rel=0.02)
    assert float(str(row[3])) == pytest.approx(analysis.margins.modulus, abs=1e-3)


def test_the_slider_moves_every_trace_and_begins_at_the_designed_one(analysis: Analysis) -> None:
    (section,) = outlook_section(analysis, SIGNALS, present=PIDController(K=1.0, Ti_s=90.0))
    drawn = json.loads(section.figures[0].figure.to_json())
    (slider,) = drawn["layout"]["sliders"]
    assert len(slider["steps"]) > 2
    assert slider["steps"][slider["active"]]["label"] == "designed"
    now = [trace.get("visible", True) for trace in drawn["data"]]
    assert slider["steps"][slider["active"]]["args"][0]["visible"] == now
    for step in slider["steps"]:
        assert len(step["args"][0]["visible"]) == len(now)
        assert sum(step["args"][0]["visible"]) == sum(now)
    assert section.tables[0].rows[0][0] == "today"


def test_a_controller_of_the_slider_is_named_by_the_margin_that_it_keeps() -> None:
    """A noise gain that binds keeps the fast ones from being as fast as was asked."""
    facts = LoopFacts(noise_sd=0.05, u_span=20.0, sample_time_s=0.1)
    held = analyse((), DesignSettings(noise_gain=8.0), fit=known(OVEN, 0.03), facts=facts)
    (section,) = outlook_section(held, SIGNALS)
    others = [row for row in section.tables[0].rows if row[0] != "designed"]
    assert others
    for name, _, _, modulus, *_ in others:
        assert float(str(name).split()[-1]) == pytest.approx(float(str(modulus)), abs=0.0051)
        assert abs(float(str(modulus)) - held.margins.modulus) >= APART


def test_a_page_of_a_run_offers_a_set_point_weight_where_steps_overshoot_and_compares_with_before() -> None:
    facts = LoopFacts(noise_sd=0.05, u_span=20.0, sample_time_s=0.1)
    fast = analyse((), DesignSettings(noise_gain=50.0), fit=known(OVEN, 0.03), facts=facts)
    said = " ".join(outlook_sentences(fast, PIDController(K=1.0, Ti_s=90.0)))
    assert re.search(r"times smaller than with the gains before", said)
    assert re.search(r"set-point weight b = [\d.]+ the set-point's step overshoots \d+ % instead of \d+ %", said)


def test_a_curve_of_the_bode_diagram_ends_at_no_point(analysis: Analysis) -> None:
    at = (1e-5, 40.0)
    unknown = ((1.0, 0.0), (0.0, 1.0))
    points = tuple(FrequencyPoint(omega_rad_s=omega, response=0.5 - 0.5j, covariance=unknown) for omega in at)
    grid = frequency_grid(replace(analysis, points=points), 0.7)
    assert grid[0] <= at[0]
    assert grid[-1] > at[-1]


def test_gains_of_zero_are_no_gains_to_compare_with(analysis: Analysis) -> None:
    """A device whose controller nobody has set holds them."""
    unset = PIDController(K=0.0, Ti_s=1.0)
    assert "gains before" not in " ".join(outlook_sentences(analysis, unset))
    (section,) = outlook_section(analysis, SIGNALS, present=unset)
    assert section.tables[0].rows[0][0] != "today"


def test_more_margin_means_less_overshoot_and_a_larger_peak_under_load(analysis: Analysis) -> None:
    (section,) = outlook_section(analysis, SIGNALS)
    rows = section.tables[0].rows  # from careful to fast
    modulus, peak = ([float(str(row[i])) for row in rows] for i in (3, 6))
    overshoot = [float(str(row[5]).split()[0]) for row in rows]
    assert modulus == sorted(modulus, reverse=True)
    assert peak == sorted(peak, reverse=True)
    assert overshoot == sorted(overshoot)


def test_a_set_point_weight_is_offered_that_keeps_the_overshoot_down(analysis: Analysis) -> None:
    (section,) = outlook_section(analysis, SIGNALS)
    said = re.search(r"b = ([\d.]+) the set-point's step overshoots (\d+) % instead of (\d+) %", " ".join(section.text))
    assert said is not None
    weight, c, s = float(said[1]), analysis.controller, control.tf("s")
    plant = control.tf([0.8], [90.0, 1.0]) * control.tf(*control.pade(OVEN.delay_s, 12))
    feedback = c.K * (1 + 1 / (c.Ti_s * s)) / (c.Tf_s * s + 1)
    forward = c.K * (weight + 1 / (c.Ti_s * s)) / (c.K * (1 + 1 / (c.Ti_s * s)))
    _, y = control.step_response(
        control.minreal(forward * control.feedback(plant * feedback, 1), verbose=False), np.linspace(0.0, 600.0, 6000)
    )
    assert 100.0 * (y.max() - 1.0) == pytest.approx(float(said[2]), abs=3.0)
    assert float(said[2]) <= 10.0 < float(said[3])


def test_the_loads_error_is_compared_with_that_of_todays_gains(analysis: Analysis) -> None:
    half = PIDController(K=0.5 * analysis.controller.K, Ti_s=analysis.controller.Ti_s)
    (section,) = outlook_section(analysis, SIGNALS, present=half)
    said = re.search(r"is ([\d.]+) times smaller", " ".join(section.text))
    assert said is not None
    # the integral of the error under a load is T_I/K where nothing overshoots
    assert float(said[1]) == pytest.approx(2.0, rel=0.15)


@given(gain=st.floats(0.05, 50.0), lag=st.floats(2.0, 200.0), delay=st.floats(0.0, 30.0), seed=st.integers(0, 2**32))
def test_a_plant_explains_all_of_its_own_recording(gain: float, lag: float, delay: float, seed: int) -> None:
    t = 0.5 * np.arange(600)
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(40.0, 60.0, 12), 50)
    plant = TransferFunction(num=(gain,), den=(lag, 1.0), delay_s=delay)
    # exact between samples: the command is held, the delayed one piece by piece
    fine = np.linspace(0.0, t[-1], 40 * (t.size - 1) + 1)
    held = u[np.clip(np.floor((fine - delay) / 0.5 + 1e-9), 0, t.size - 1).astype(int)]
    blend, y = math.exp(-(fine[1] - fine[0]) / lag), np.empty(fine.size)
    y[0] = gain * u[0] + random.normal(0.0, gain)  # not at rest
    for k in range(1, fine.size):
        y[k] = blend * y[k - 1] + (1.0 - blend) * gain * held[k - 1]
    recording = Recording(t=t, u=u, y=7.0 + y[::40], name="made")
    (figure,) = model_figures(replace(known(plant), source="points"), (recording,), SIGNALS)
    found = re.search(r"explains (-?\d+) % of y", figure.caption)
    assert found is not None
    assert int(found[1]) >= 99


def test_a_plant_that_rings_explains_its_own_decay():
    t = 0.1 * np.arange(400)
    plant = TransferFunction(num=(1.0,), den=(1.0, 0.2, 1.0))
    decay = np.exp(-0.1 * t) * np.sin(math.sqrt(0.99) * t)  # from a speed, with the command at rest
    recording = Recording(t=t, u=np.full(t.size, 2.0), y=2.0 + decay, name="ringing")
    (figure,) = model_figures(replace(known(OVEN), plant=plant, source="points"), (recording,), SIGNALS)
    assert "explains 100 % of y" in figure.caption


def test_intervals_of_the_numbers_hold_what_the_region_does(analysis: Analysis) -> None:
    rows = {str(row[0]): (float(str(row[1])), str(row[2])) for row in numbers_table(analysis.fit, SIGNALS).rows}
    for name, value in (("gain [degC/%]", 0.8), ("lag 1 [s]", 90.0)):
        middle, ends = rows[name]
        low, high = (float(end) for end in ends.split(" to "))
        assert middle == pytest.approx(value)
        assert (math.log(high) - math.log(low)) / (2.0 * 1.96 * 0.03) == pytest.approx(1.0, abs=0.25)
    assert rows["dead time [s]"][0] == pytest.approx(8.0)


def test_a_page_claims_no_slider_no_band_and_no_second_column_that_are_not_there() -> None:
    """A lag without dead time, known to a hundred-thousandth: noise alone binds, and no other margin can be had."""
    facts = LoopFacts(noise_sd=0.05, u_span=20.0, sample_time_s=0.1)
    lag = TransferFunction(num=(0.8,), den=(90.0, 1.0))
    known_well = analyse((), DesignSettings(noise_gain=20.0), fit=known(lag, 1e-5), facts=facts)
    (section,) = outlook_section(known_well, SIGNALS)
    assert not json.loads(section.figures[0].figure.to_json())["layout"].get("sliders")
    assert section.figures[0].caption == ""
    assert "narrower than its line" in section.text[0]
    assert known_well.source == "fitted plant"
    loop = next(one for one in analysis_sections(known_well, SIGNALS, None) if one.title == "Controller and margins")
    assert loop.tables[0].header == ("", "fitted plant")


def test_margins_said_of_the_fitted_plant_are_its_own_and_not_those_of_its_region(analysis: Analysis) -> None:
    assert analysis.source == "fitted plant"
    loop = next(one for one in analysis_sections(analysis, SIGNALS, None) if one.title == "Controller and margins")
    table, own = loop.tables[0], margins(analysis.fit.plant, analysis.controller)
    rows = {str(row[0]): [float(str(cell)) for cell in row[1:]] for row in table.rows}
    assert table.header == ("", "fitted plant", "least over its region")
    assert rows["modulus margin"][0] == pytest.approx(own.modulus, rel=1e-3)
    assert rows["phase margin [deg]"][0] == pytest.approx(math.degrees(own.phase_rad), rel=1e-3)
    assert all(rows[name][1] < rows[name][0] for name in ("modulus margin", "phase margin [deg]"))


def test_a_point_has_no_more_digits_than_its_interval_tells(analysis: Analysis) -> None:
    """Of a gain that is known to 14 % three digits are printed, of one known to 0.1 % five."""
    points = tuple(
        FrequencyPoint(omega_rad_s=0.1 * k, response=0.089257j, covariance=((var, 0.0), (0.0, var)))
        for k, var in ((1, (0.14 * 0.089257 / 1.96) ** 2), (2, (0.001 * 0.089257 / 1.96) ** 2))
    )
    rows = points_section(replace(analysis, points=points), SIGNALS, None).tables[0].rows
    assert [row[1] for row in rows] == ["0.0893", "0.089257"]
    assert [row[2] for row in rows] == ["-270.0", "-270.00"]
