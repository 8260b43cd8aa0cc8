"""What no catalogue knows, described: signal and shape come out, and noise is not described."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.evidence.description import Description, describe
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.retuning import prepare
from autotune.effects import CATALOGUE
from autotune.model_tables import read_model
from autotune.recording import Recording, read_recording
from tests.autotune.diagnosis.servo_rigs import servo_model, servo_recording


def described(*recordings: Recording) -> Description:
    data, retuned = prepare(servo_model(), recordings, inspect(recordings)[0])
    return describe(retuned, data)


def spring(x: float, v: float) -> float:
    """Push back on one side only, with the square of the position."""
    return -0.3 * max(x, 0.0) ** 2


def test_a_spring_on_one_side_shows_as_a_function_of_position_that_is_flat_on_the_other() -> None:
    found = described(servo_recording(1, spring), servo_recording(2, spring))
    assert found.place == "plant"
    assert {t.text for t in found.terms} == {"position^2", "position |position|"}
    even, odd = (next(t.value for t in found.terms if t.text == text) for text in ("position^2", "position |position|"))
    assert even < 0.0
    assert odd == pytest.approx(even, rel=0.15)  # together (x^2 + x |x|): twice x^2 above zero, nothing below
    assert found.explained > 0.9


def test_the_free_curve_has_the_shape_of_the_missing_force() -> None:
    found = described(servo_recording(3, spring), servo_recording(4, spring))
    curve = found.curve
    truth = np.array([spring(x, 0.0) for x in curve.x])
    assert curve.signal == "position"
    assert np.corrcoef(curve.value, truth)[0, 1] > 0.99
    left = curve.x < -0.3
    assert np.ptp(curve.value[left]) < 0.1 * np.ptp(curve.value)


def test_a_drag_is_found_in_the_speed_with_its_size() -> None:
    found = described(*(servo_recording(seed, lambda x, v: -0.03 * v * abs(v)) for seed in (5, 6)))
    shapes = {"speed |speed|": lambda v: v * abs(v), "speed^3": lambda v: v**3}
    assert {t.text for t in found.terms} <= set(shapes)
    missing = sum(t.value * shapes[t.text](4.0) for t in found.terms)
    assert missing == pytest.approx(-0.03 * 16.0, rel=0.15)


def test_a_damper_on_one_side_is_half_straight_and_half_bent_and_only_the_bent_half_can_be_seen() -> None:
    found = described(*(servo_recording(seed, lambda x, v: -0.1 * max(v, 0.0)) for seed in (7, 8)))
    assert [t.text for t in found.terms] == ["|speed|"]
    assert found.terms[0].value == pytest.approx(-0.05, rel=0.1)


def test_a_sensor_that_sees_the_past_or_the_command_is_described_as_such() -> None:
    """An echo of 0.2 after 0.5 s, and a twentieth of the command held while the reading was taken."""
    plain = [servo_recording(seed) for seed in (14, 15)]
    echoes = [replace(r, y=r.y + 0.2 * np.interp(r.t - 0.5, r.t, r.y)) for r in plain]
    found = described(*echoes)
    assert found.place == "sensor"
    assert all(t.text.startswith("(reading") for t in found.terms)
    leaks = [replace(r, y=r.y + 0.05 * np.append(r.u[0], r.u[:-1])) for r in plain]
    found = described(*leaks)
    assert [t.text for t in found.terms] == ["command"]
    assert found.terms[0].value == pytest.approx(0.05, rel=0.1)


def test_noise_alone_is_not_described() -> None:
    found = described(servo_recording(9), servo_recording(10))
    assert found.terms == ()
    assert found.explained == 0.0
    assert "no simple function" in found.sentence.lower()


def test_a_diagnosis_is_described_only_where_nothing_explains_it() -> None:
    recordings = [servo_recording(seed, spring) for seed in (11, 12)]
    nothing_fits = [name for name in CATALOGUE if name != "actuator.rate_limit"]
    said = diagnose(servo_model(), recordings, without=nothing_fits).as_json()
    assert said["verdict"] == "unexplained"
    assert said["description"]["note"] == "a description, not a cause"
    assert "position" in said["description"]["equation"]
    explained = diagnose(servo_model(), [servo_recording(13)], without=nothing_fits).as_json()
    assert explained["verdict"] == "none"
    assert "description" not in explained


@pytest.mark.parametrize(
    ("rig", "term", "signal"), [("silverbox", "position^3", "position"), ("emps", "sign(speed)", "speed")]
)
def test_a_real_rig_without_its_effect_in_the_catalogue_is_described_by_the_law_of_its_makers(
    shared: Path, rig: str, term: str, signal: str
) -> None:
    recording = read_recording(shared / "data" / rig / "fit.csv")
    data, result = prepare(read_model(shared / "data" / rig / "model.toml"), [recording], inspect([recording])[0])
    found = describe(result, data)
    assert found.terms[0].text == term
    assert found.terms[0].value < 0.0  # a hardening spring, a friction
    assert found.curve.signal == signal
    assert found.explained > 0.9
