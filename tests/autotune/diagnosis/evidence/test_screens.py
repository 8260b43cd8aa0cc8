"""Screens: each shows what it is for, and stays silent where there is nothing."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.evidence.screens import (
    direction_screen,
    law_screen,
    period_of,
    period_screen,
    spectrum_screen,
    stamp_screen,
    value_screen,
    window_screen,
)
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.retuning import prepare
from autotune.effects import CATALOGUE
from autotune.recording import Recording
from autotune.report.diagnosis_page import write_diagnosis_page
from tests.autotune.diagnosis.servo_rigs import K, servo_model, servo_recording


def retuned(*recordings: Recording) -> tuple[Fit, Data]:
    data, result = prepare(servo_model(), recordings, inspect(recordings)[0])
    return result, data


@pytest.mark.parametrize("period", [20, 75, 160])
def test_the_period_of_a_periodic_command_is_found(period: int) -> None:
    k = np.arange(1000)
    assert period_of(np.sign(np.sin(2.0 * np.pi * (k + 0.3) / period))) == pytest.approx(period, abs=1)


def test_random_steps_have_no_period() -> None:
    assert period_of(np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, 50), 20)) == 0


def test_stamps_off_their_grid_are_counted() -> None:
    r = servo_recording(1, rows=300)
    assert stamp_screen([r]).sentence == "Every time stamp is on its grid to within 1 %."
    late = r.t.copy()
    late[100] += 0.01
    assert stamp_screen([replace(r, t=late)]).sentence.startswith("2 of 299 steps")


def test_a_converter_shows_its_step() -> None:
    r = servo_recording(2, rows=500)
    assert value_screen([r]).step == 0.0
    coarse = value_screen([replace(r, y=0.05 * np.round(r.y / 0.05))])
    assert coarse.step == pytest.approx(0.05)


def test_the_recomputed_law_shows_the_gain_that_really_ran() -> None:
    screen = law_screen([servo_recording(3, shown_gain=0.5 * K)])
    assert screen is not None
    shown = re.search(r"shows ([\d.]+) ±", screen.sentence)
    assert shown is not None
    assert float(shown.group(1)) == pytest.approx(2.0, rel=0.05)
    assert law_screen([replace(servo_recording(3), metadata={})]) is None


def test_a_spring_on_one_side_makes_even_harmonics_and_a_drag_on_both_odd_ones() -> None:
    def even_share(force: object) -> float:
        screen = period_screen(*retuned(servo_recording(4, force, period=150)))  # type: ignore[arg-type]
        assert screen is not None
        power = np.maximum(screen.harmonics**2 - screen.floor**2, 0.0)
        return float(power[1::2].sum() / power[1:].sum())

    assert even_share(lambda x, v: -0.3 * max(x, 0.0) ** 2) > 0.5
    assert even_share(lambda x, v: -0.05 * v * abs(v)) < 0.1


def test_friction_of_one_direction_shows_as_a_difference_between_up_and_down() -> None:
    rough = direction_screen(*retuned(servo_recording(5, lambda x, v: -0.2 * (v > 0.0))))
    smooth = direction_screen(*retuned(servo_recording(5)))
    assert rough is not None
    assert smooth is not None
    assert rough.sentence.endswith("more than chance.")
    assert smooth.sentence.endswith("within chance.")


def test_a_gain_that_goes_with_the_position_shows_window_by_window() -> None:
    varying = window_screen(*retuned(*(servo_recording(s, lambda x, v: -0.5 * x * abs(x), rows=1500) for s in (6, 7))))
    steady = window_screen(*retuned(*(servo_recording(s, rows=1500) for s in (6, 7))))
    assert varying is not None
    assert steady is not None
    assert "reading" in varying.against
    assert steady.sentence.startswith("No number varies")


def test_the_spectrum_of_a_good_model_is_that_of_the_noise() -> None:
    result, data = retuned(servo_recording(8, rows=2000))
    screen = spectrum_screen(result, result, data)
    assert np.median(screen.retuned / screen.noise) == pytest.approx(1.0, abs=0.35)
    assert screen.sentence.startswith("At no frequency")


def test_the_page_shows_every_screen_that_ran_and_says_which_did_not(tmp_path: object) -> None:
    nothing_fits = [name for name in CATALOGUE if name != "actuator.rate_limit"]
    recordings = [servo_recording(9, lambda x, v: -0.3 * max(x, 0.0) ** 2), servo_recording(10, period=100)]
    write_diagnosis_page(diagnose(servo_model(), recordings, without=nothing_fits), f"{tmp_path}/page.html")
    with open(f"{tmp_path}/page.html", encoding="utf-8") as stream:
        page = stream.read()
    for caption in (
        "Time stamps.", "Readings.", "Control law recomputed.", "Residual over time", "Residual over frequency.",
        "Repeated periods.", "Odd and even harmonics.", "Up against down.", "Numbers in every window alone.",
        "Mean residual over position", "A description, not a cause",
    ):  # fmt: skip
        assert caption in page, caption
    assert not re.search(r'<(script|link|img)[^>]*(src|href)="http', page)
