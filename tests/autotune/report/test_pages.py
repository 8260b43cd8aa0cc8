"""Pages of many loops and of a proof: what a reader finds on them."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.batch.plant_figures import plant_figures
from autotune.batch.row import Row
from autotune.batch.settings import CampaignSettings
from autotune.config.procedure import DesignSettings, SignalSettings
from autotune.controller import PIDController
from autotune.design.noise import LoopFacts
from autotune.identification.parametric import fit_plant
from autotune.models import TransferFunction
from autotune.pipeline import analyse
from autotune.points import FrequencyPoint
from autotune.report.analysis_words import reason_without_reduced
from autotune.report.campaign_page import campaign_page
from autotune.report.maker_forms import maker_table
from autotune.report.page import write_page
from autotune.report.proof_page import proof_page
from autotune.report.tuned_page import analysis_page
from sim.score import wilson


@given(gain=st.floats(0.1, 100.0), lag_s=st.floats(0.01, 1e4), delay_s=st.floats(0.0, 100.0))
def test_the_step_of_a_lag_with_dead_time_in_a_few_numbers_is_the_textbooks(gain, lag_s, delay_s):
    found = plant_figures(TransferFunction(num=(gain,), den=(lag_s, 1.0), delay_s=delay_s))
    assert found["gain"] == pytest.approx(gain)
    assert float(found["lags_s"]) == pytest.approx(lag_s, rel=6e-3)
    step = np.array(found["step"].split(), dtype=float)
    t = np.linspace(0.0, found["step_s"], step.size)
    np.testing.assert_allclose(step, gain * -np.expm1(-np.maximum(t - delay_s, 0.0) / lag_s), atol=0.012 * gain)


def test_an_oscillating_pair_is_told_by_its_frequency_and_damping():
    found = plant_figures(TransferFunction(num=(8.0,), den=(1.0, 0.4, 4.0, 0.0)))
    assert found["lags_s"] == "2 rad/s with damping 0.1"
    assert (found["integrators"], found["gain"]) == (1, 2.0)


@pytest.mark.parametrize(("which", "shown"), [((), "none"), ((0,), "one"), ((2, 3, 4), "two")])
def test_why_there_is_no_reduced_model_of_a_recording_is_a_sentence_with_a_remedy(which, shown):
    """Points past -270 degrees are none that a reduction takes."""
    plant = TransferFunction(num=(1.0,), den=(2.0, 3.0, 1.0), delay_s=1.0)
    omega = np.array([0.2, 0.4, 0.7, 1.0, 2.6])
    points = [
        FrequencyPoint(omega_rad_s=w, response=complex(G), covariance=((v := abs(2e-3 * G) ** 2, 0.0), (0.0, v)))
        for w, G in zip(omega, plant.response(omega), strict=True)
    ]  # fmt: skip
    fit = replace(fit_plant(points[:4]), source="recording")
    given = [points[i] for i in which]
    said = reason_without_reduced(analyse(given, DesignSettings(), fit=fit, facts=LoopFacts(sample_time_s=0.05)))
    assert f"of u and y as they were recorded {shown} can be told" in said
    assert "designed on the fitted plant" in said
    assert "record while u goes up and down" in said


@pytest.mark.parametrize(
    ("gain", "said", "name"),
    [
        (0.2, "the loops stay outside the circle", "reduced model"),
        (1.0, "more cautious, enters it", "reduced model"),
        (6.0, "unstable with this controller", "reduced model (unstable)"),
    ],
)
def test_the_nyquist_curve_of_the_reduced_model_is_called_what_it_is(gain, said, name):
    plant = TransferFunction(num=(1.0,), den=(6.0, 11.0, 6.0, 1.0), delay_s=0.2)
    points = [
        FrequencyPoint(
            omega_rad_s=w, response=complex(value), covariance=((s := abs(2e-3 * value) ** 2, 0.0), (0.0, s))
        )
        for w, value in zip((0.3, 0.5, 0.7, 0.9, 1.1), plant.response(np.array([0.3, 0.5, 0.7, 0.9, 1.1])), strict=True)
    ]
    found = analyse(points, DesignSettings(source="points"), compare=False)
    law = found.controller
    controller = replace(law, K=gain * law.K, Ti_s=max(law.Ti_s, law.Ti_s / gain))
    page = analysis_page(
        "a", SignalSettings(sample_time_s=0.1), [], replace(found, design=replace(found.design, controller=controller))
    )
    figures = [figure for section in page.sections for figure in section.figures]
    nyquist = next(figure for figure in figures if figure.caption.startswith("Nyquist"))
    assert said in nyquist.caption
    assert name in [trace["name"] for trace in nyquist.figure.data]


def test_a_page_gives_the_gains_as_makers_blocks_take_them():
    table = maker_table(PIDController(K=-1.2, Ti_s=90.0))
    said = dict(table.rows)
    assert said["ISA (ideal, standard)"] == "K = 1.2, Ti_s = 90, Td_s = 0, Tf_s = 0, Ti_min = 1.5"
    assert said["parallel (independent gains)"].startswith("Kp = 1.2, Ki_per_s = 0.01333")
    assert said["Siemens PID_Compact"].startswith("Gain = 1.2, Ti = 90")
    assert "direct" in table.caption
    pid = PIDController(K=1.0, Ti_s=3.0, Td_s=1.0, Tf_s=0.1)
    assert "complex" in dict(maker_table(pid).rows)["series (interacting)"]


def test_every_loop_of_a_large_campaign_is_a_square_that_leads_to_its_row(tmp_path):
    kinds = ("act", "fine", "look", "fine", "fine")
    rows = [
        Row(loop=f'"{i}" <loop>', area="mill" if i % 2 else "boilers", attention=kinds[i % 5], reason="a & b", K=1.0)
        for i in range(40)
    ]
    rows.sort(key=lambda row: row.order)
    write_page(campaign_page(CampaignSettings(name="site"), rows), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    squares = re.findall(r'<a href="#([^"]+)" title="([^"]+)" style="background:#', page)
    assert len(squares) == 40
    for target, title in squares:
        (cell,) = re.findall(rf'<td><span id="{target}">([^/]+)</span>', page)
        assert html.unescape(title) == f"{html.unescape(cell)}: a & b"
    assert re.findall("<h3>(.*?)</h3>", page) == ["boilers (20)", "mill (20)"]
    few = campaign_page(CampaignSettings(name="site"), rows[:5])
    assert few.drawing == ""


def test_loops_that_were_only_identified_are_not_said_to_be_fine():
    rows = [Row(loop="TIC1", attention="fine", points=8), Row(loop="TIC2", attention="fine", points=8)]
    page = campaign_page(CampaignSettings(name="boilers", task="identify"), rows)
    assert page.verdict == "Of 2 loops, 2 are identified."
    assert page.sections[0].title == "Identified (2)"
    assert "Nothing is said of the gains in use" in dict(page.answers)["What to do"]


def test_a_campaigns_page_names_the_command_that_designs_a_loop_as_the_campaign_did():
    """Points alone are not what a design from recordings rests on; a subspace model's points are."""
    rows = [Row(loop="TIC1", attention="fine", K=1.0, Ti_s=90.0)]
    said = " ".join(campaign_page(CampaignSettings(name="a"), rows).summary)
    assert "autotune tune FILE --out DIR, with --u and --y where FILE has several loops" in said
    by_subspace = campaign_page(CampaignSettings(name="a", method="closed-loop"), rows)
    assert "autotune tune --points loops/NAME.json --out DIR" in " ".join(by_subspace.summary)


def test_a_campaigns_page_shows_every_loops_plant_and_says_what_to_do(tmp_path):
    figures = plant_figures(TransferFunction(num=(0.8,), den=(90.0, 1.0), delay_s=20.0))
    rows = [
        Row(
            loop="TIC1",
            attention="act",
            reason="margin 40 % too small",
            u_unit="%",
            y_unit="degC",
            K=1.0,
            Ti_s=90.0,
            **figures,
        ),
        Row(loop="TIC2", attention="fine", K=1.0, Ti_s=90.0, **figures),
    ]
    write_page(campaign_page(CampaignSettings(name="boilers"), rows), tmp_path / "page.html")
    content = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert content.count("<polyline") == 2
    for said in (
        "0.8\N{NO-BREAK SPACE}degC/%",
        "1\N{NO-BREAK SPACE}%/degC, 90",
        ">90<",
        ">20<",
        "Retune what needs action first",
    ):
        assert said in content


def test_the_page_of_a_proof_has_its_figures_calibration_and_misses(tmp_path):
    mark = {"case": "case_1", "kind": "single", "strength": "clear", "rig": "servo", "verdict": "effect", "gap": 0.2}
    mark |= {"true_names": ["plant.coulomb_friction"], "named": ["actuator.backlash"], "probabilities": [0.6]}
    mark |= {"right": [False], "place_right": False}
    row = {"figure": "clear effects named", "asked": ">= 90 %", "value": 0.5, "interval": [0.1, 0.9]}
    row |= {"count": 2, "met": False}
    result = {"table": [row], "cases": 2, "marks": [mark], "sha256": "ab" * 32}
    page = proof_page(result, [mark], [("plant.coulomb_friction", 2, 1, [("actuator.backlash", 1)])], wilson)
    write_page(page, tmp_path / "page.html")
    content = (tmp_path / "page.html").read_text(encoding="utf-8")
    for said in ("1 of 2 concealed cases", "Not reached: clear effects named", "actuator.backlash (0.60)", "0 of 1"):
        assert said in content
