"""A law over its signal, and a free run on unseen rows: what the data say does not come from the curve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.evidence.effect_line import line_of
from autotune.diagnosis.evidence.missing_law import MissingLaw, law_of
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.evidence.unseen_run import unseen_run
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit, fit
from autotune.diagnosis.fitting.parameters import effect_with, parametrise
from autotune.diagnosis.fitting.retuning import prepare
from autotune.effects import CATALOGUE, kind_of
from tests.autotune.diagnosis.servo_rigs import GAIN, servo_model, servo_recording

DRAG, FRICTION = 0.06, 0.12
#: Each by the force that the rig really has, the effect's parameters, and its law at the plant's input.
LAWS: dict[str, tuple[Callable[[float, float], float], tuple[float, ...], Callable[[np.ndarray], np.ndarray]]] = {
    "plant.quadratic_drag": (
        lambda x, v: -DRAG / GAIN * v * abs(v), (DRAG,), lambda v: -DRAG / GAIN * v * np.abs(v),
    ),
    "plant.coulomb_friction": (
        lambda x, v: -FRICTION * np.sign(v), (FRICTION,), lambda v: -FRICTION * np.sign(v),
    ),
    "plant.cubic_stiffness": (lambda x, v: -0.1 * x**3, (0.1,), lambda x: -0.1 * x**3),
}  # fmt: skip


def fitted(name: str, factor: float) -> tuple[Fit, Data]:
    """Return a fit of true chain numbers and an effect of a factor times its true size, start states fitted."""
    force, values, _ = LAWS[name]
    recordings = [servo_recording(seed, force, rows=1500) for seed in (1, 2)]
    data, _ = prepare(servo_model(), recordings, inspect(recordings)[0])
    p = parametrise(servo_model(), [effect_with(name, [factor * v for v in values])], 1.0, 0.02)
    return fit(p, data, free=np.zeros(p.centre.size, dtype=bool)), data


def law_by(result: Fit, data: Data, name: str) -> MissingLaw | None:
    number = [effect.name for effect in result.model.effects].index(name)
    return law_of(line_of(result, data, number, kind_of(name)))


def off(law: MissingLaw, true: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float, float]:
    """Return how far bins and curve are from the true law (rms), and the rms of the bins' deviation in bars."""
    (branch,) = law.branches
    at, curve = branch.at, np.interp(branch.at, branch.x, branch.law)
    bins = branch.found - true(at)
    return (
        float(np.sqrt(np.mean(bins**2))),
        float(np.sqrt(np.mean((curve - true(at)) ** 2))),
        float(np.sqrt(np.mean((bins / branch.error) ** 2))),
    )


@pytest.mark.parametrize("name", LAWS)
def test_the_bins_show_the_true_law_where_the_curve_has_another_size(name: str) -> None:
    law = law_by(*fitted(name, 0.7), name)
    assert law is not None
    bins, curve, bars = off(law, LAWS[name][2])
    assert law.branches[0].at.size >= 3
    # a stiffness changes the dynamics through which it is seen: the first order goes a part of the way
    assert bins < {"plant.cubic_stiffness": 0.85}.get(name, 0.4) * curve
    assert bars < 2.0


@pytest.mark.parametrize("name", LAWS)
def test_the_bins_lie_on_the_right_law_to_within_their_bars_and_contradict_its_absence(name: str) -> None:
    law = law_by(*fitted(name, 1.0), name)
    assert law is not None
    (branch,) = law.branches
    assert off(law, LAWS[name][2])[2] < 2.0
    assert np.any(np.abs(branch.found) > 3.0 * branch.error)


def test_a_play_has_two_branches_and_its_middle_is_the_command() -> None:
    recordings = [servo_recording(3)]
    data, _ = prepare(servo_model(), recordings, inspect(recordings)[0])
    p = parametrise(servo_model(), [effect_with("actuator.backlash", [0.2])], 1.0, 0.02)
    law = law_by(fit(p, data, free=np.zeros(p.centre.size, dtype=bool)), data, "actuator.backlash")
    assert law is not None
    rising, falling = law.branches
    assert law.is_whole
    inner = (rising.x > rising.x.min() + 0.2) & (rising.x < rising.x.max() - 0.2)
    np.testing.assert_allclose((falling.law - rising.law)[inner], 0.2, atol=1e-9)
    np.testing.assert_allclose((0.5 * (falling.law + rising.law))[inner], rising.x[inner], atol=1e-9)
    assert np.abs(law.acts[0]).max() == pytest.approx(0.1)


def test_what_is_no_law_over_one_signal_is_not_drawn_as_one() -> None:
    recordings = [servo_recording(4)]
    data, _ = prepare(servo_model(), recordings, inspect(recordings)[0])
    for name in ("actuator.lag", "timing.dead_time"):
        p = parametrise(servo_model(), [effect_with(name, [0.05])], 1.0, 0.02)
        assert law_by(fit(p, data, free=np.zeros(p.centre.size, dtype=bool)), data, name) is None
    known = fit(p, data, free=np.zeros(p.centre.size, dtype=bool))
    drawn = {name for name in CATALOGUE if line_of(known, data, 0, kind_of(name)) is not None}
    assert {"plant.quadratic_drag", "actuator.saturation", "sensor.nonlinear_gain", "environment.step_load"} <= drawn
    assert not {"actuator.rate_limit", "plant.hard_stop", "timing.clock_error", "plant.resonance"} & drawn


def test_no_number_of_a_free_run_has_seen_the_readings_of_its_stretch() -> None:
    r = servo_recording(5, LAWS["plant.quadratic_drag"][0], rows=2000)
    data, retuned = prepare(servo_model(), [r], [np.isfinite(r.y)])
    p = parametrise(servo_model(), [effect_with("plant.quadratic_drag", [DRAG])], 1.0, 0.02)
    chosen = fit(p, data)
    seen = unseen_run(retuned, retuned, chosen, data)
    assert seen is not None
    y = r.y.copy()
    told = np.zeros(y.size, dtype=bool)
    for a, b in zip(seen.starts_s, seen.heads_s, strict=True):
        told |= (r.t >= a) & (r.t < b)
    hidden = (r.t >= seen.t[0]) & (r.t <= seen.t[-1]) & ~told
    y[hidden] += 0.02 * np.sin(np.arange(hidden.sum()))
    again = unseen_run(retuned, retuned, chosen, replace(data, recordings=(replace(r, y=y),)))
    assert again is not None
    assert hidden.sum() > 200
    assert seen.t[0] == again.t[0]
    for name, run in seen.runs.items():
        np.testing.assert_array_equal(run, again.runs[name])
    assert seen.errors["extended"] < 0.5 * seen.errors["retuned"]


def test_a_recording_too_short_for_a_stretch_has_no_free_run() -> None:
    r = servo_recording(6, rows=90)
    data, retuned = prepare(servo_model(), [r], [np.isfinite(r.y)])
    assert unseen_run(retuned, retuned, retuned, data) is None


def test_the_number_of_a_recording_goes_with_a_load_that_comes_in_it_alone() -> None:
    recordings = [servo_recording(7, rows=400), servo_recording(8, rows=900)]
    data, _ = prepare(servo_model(), recordings, inspect(recordings)[0])
    p = parametrise(servo_model(), [effect_with("environment.step_load", [0.2, 4.0, 1e9, 1.0])], 1.0, 0.02)
    law = law_by(fit(p, data, free=np.zeros(p.centre.size, dtype=bool)), data, "environment.step_load")
    assert law is not None
    assert np.all(law.acts[0] == 0.0)
    assert law.acts[1].max() == pytest.approx(0.2)


def test_a_signal_whose_rows_fill_no_bin_has_a_law_without_bins() -> None:
    r = servo_recording(6, rows=90)
    data, _ = prepare(servo_model(), [r], [np.isfinite(r.y)])
    p = parametrise(servo_model(), [effect_with("plant.quadratic_drag", [DRAG])], 1.0, 0.02)
    law = law_by(fit(p, data, free=np.zeros(p.centre.size, dtype=bool)), data, "plant.quadratic_drag")
    assert law is not None
    (branch,) = law.branches
    assert branch.x.size > 0
    assert np.all(branch.rows >= 20)
