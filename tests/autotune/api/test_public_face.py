"""``import autotune as at``: what a person finds, from what a person has, to what other libraries take."""

from __future__ import annotations

import doctest
import importlib
import math
import pkgutil
import subprocess
import sys
from dataclasses import replace

import control
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

import autotune as at
import autotune.api
from autotune.errors import InputError

mpl.use("Agg")


@pytest.fixture(scope="module")
def oven() -> at.Recording:
    return at.example("oven")


def test_a_bare_import_brings_nothing_heavy():
    script = (
        "import sys, autotune; print([m for m in ('numpy', 'scipy', 'control', 'plotly', 'numba') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_help_of_the_command_line_needs_no_arrays_and_no_schema():
    script = (
        "import sys, autotune.cli; "
        "print([m for m in ('numpy', 'scipy', 'pydantic', 'plotly', 'numba') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("command", [[], ["tune"], ["identify", "delay"]])
def test_the_short_option_for_help_is_heard_everywhere(command):
    asked = [sys.executable, "-m", "autotune", *command, "-h"]
    done = subprocess.run(asked, capture_output=True, text=True, check=True)
    assert "Usage: " in done.stdout


def test_every_public_name_is_there_has_a_docstring_and_no_room_hides_it():
    for name in at.__all__:
        value = getattr(at, name)
        assert value.__doc__, name
        assert not isinstance(value, type(sys)), f"{name} is a module"
    assert 15 <= len(at.__all__) <= 25
    with pytest.raises(AttributeError, match="no attribute"):
        _ = at.nothing


@pytest.mark.parametrize("module", [module.name for module in pkgutil.iter_modules(autotune.api.__path__)])
def test_the_examples_in_the_docstrings_print_what_they_say(module):
    found = doctest.testmod(importlib.import_module(f"autotune.api.{module}"))
    assert found.failed == 0


def test_a_recording_from_a_frame_from_arrays_and_from_a_file_is_one_recording(oven, tmp_path):
    frame = at.to_pandas(oven)
    dated = frame.set_index(pd.Timestamp("2024-05-01") + pd.to_timedelta(frame.index, unit="s"))
    named = frame.reset_index().rename(columns={"t": "time", "u": "valve", "y": "temp"})
    named.to_csv(tmp_path / "oven.csv", index=False)
    others = [
        at.read(frame),
        at.read(dated),
        at.read(named, t="time", u="valve", y="temp"),
        at.read({"t": oven.t, "u": oven.u, "y": oven.y}),
        at.read(str(tmp_path / "oven.csv"), t="time", u="valve", y="temp"),
        at.read(oven),
    ]
    for other in others:
        np.testing.assert_allclose(other.t - other.t[0], oven.t, atol=1e-6)
        np.testing.assert_allclose(other.y, oven.y, rtol=1e-6)
    with pytest.raises(InputError, match="no column 'u'"):
        at.read(named, t="time", y="temp")
    with pytest.raises(InputError, match="is no recording"):
        at.read(3.0)


def test_systems_come_back_from_python_control_as_they_went(oven):
    plant = at.TransferFunction(num=(2.0, 1.0), den=(6.0, 5.0, 1.0))
    assert at.from_control(at.to_control(plant)) == plant
    omega = np.array([0.1, 1.0])
    late = at.TransferFunction(num=(2.0,), den=(3.0, 1.0), delay_s=0.5)
    np.testing.assert_allclose(at.to_control(late)(1j * omega), late.response(omega), rtol=1e-3)
    law = control.tf([0.5, -0.4], [1.0, -1.0], 0.1)
    back = at.to_control(at.from_control(law))
    np.testing.assert_allclose(back(np.exp(0.3j)), law(np.exp(0.3j)))
    model = at.closed_loop(at.example("loop"), order=5).estimate.model
    space = at.to_control(model)
    np.testing.assert_allclose(at.from_control(space).response(omega), model.response(omega))
    np.testing.assert_allclose(space(np.exp(1j * omega))[0, 0] if space.ninputs > 1 else space(np.exp(1j * omega)),
                               model.response(omega)[:, 0, 0])  # fmt: skip
    points = at.frequency_points(oven)
    again = at.from_control(at.to_control(points))
    assert again == points  # with their covariance, of which an FRD knows nothing
    louder = at.from_control(2.0 * at.to_control(points))
    np.testing.assert_allclose([p.response for p in louder], [2.0 * p.response for p in points])
    assert "no covariance" in louder.notes[0]


def test_points_that_went_through_python_control_give_the_same_design(oven):
    """Of a thousandth of each gain, which was taken for their covariance, they contradicted each other."""
    points = at.frequency_points(oven, largest_relative_sd=0.05)
    assert at.tune(at.to_control(points)) == at.tune(points)


def test_a_table_of_coefficients_has_all_of_their_digits():
    plant = at.TransferFunction(num=(2.0 / 3.0,), den=(math.pi, 5.0, 1.0))
    rows = dict(at.to_pandas(plant).to_numpy().tolist())
    assert (rows["num"], rows["den"]) == (plant.num, plant.den)
    placed = at.rst(plant, dominant_rad_s=1.0, rest_rad_s=3.0)
    assert dict(at.to_pandas(placed).to_numpy().tolist()) == {"R": placed.R, "S": placed.S, "T": placed.T}


@pytest.mark.parametrize(
    "plant",
    [
        at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0)),
        control.tf([2.0], [6.0, 5.0, 1.0]),
        control.ss(control.tf([2.0], [6.0, 5.0, 1.0])),
    ],
)
def test_a_plant_is_taken_in_every_form(plant):
    margins = at.margins(plant, at.PI(K=0.5, Ti_s=3.0))
    gain_margin, phase_margin, _, _ = control.margin(
        control.tf([2.0], [6.0, 5.0, 1.0]) * control.tf([1.5, 0.5], [3.0, 0.0])
    )
    assert np.degrees(margins.phase_rad) == pytest.approx(phase_margin, abs=0.01)
    assert np.isinf(gain_margin) == np.isinf(margins.gain)


def test_what_is_no_plant_is_refused_with_what_would_be():
    with pytest.raises(InputError, match="is no plant"):
        at.margins([1, 2], at.PI(K=1.0, Ti_s=1.0))
    with pytest.raises(InputError, match="is no controller"):
        at.margins(at.example("ball"), 3.0)
    with pytest.raises(InputError, match="one of ball"):
        at.example("kettle")


def test_every_result_shows_itself_plots_and_becomes_a_frame(oven):
    points = at.frequency_points(oven)
    reduced = at.reduce(points)
    design = at.tune(reduced, noise_gain=10.0, certificate=False)
    ball = at.example("ball")
    loop = at.closed_loop(at.example("loop"), order=5)
    plant = at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0))
    move = at.transition(plant, y_start=0.0, y_end=1.0, u_rest=0.0, u_min=-2.0, u_max=2.0)
    results = [oven, points, reduced, design, design.controller, design.margins, ball, loop, loop.estimate.model, move,
               at.delay(oven), at.validate(ball, at.reduce(ball), at.PI(K=-0.023, Ti_s=3.0))]  # fmt: skip
    for result in results:
        shown = result._repr_html_()
        assert shown.startswith("<table>")
        assert "nan" not in shown
        assert len(at.to_pandas(result)) > 0
        assert len(repr(result)) < 3000  # what a prompt prints of it is at most a screen
    for result in (oven, points, reduced, loop, loop.estimate.model, ball, move, at.PI(K=1.0, Ti_s=2.0), design):
        assert len(at.plot(result).data) >= 2
        figure, axes = plt.subplots(2, 1)
        assert at.plot(result, ax=axes) is axes
        assert all(axis.lines or axis.containers for axis in axes)
        legend = axes[0].get_legend()
        names = [text.get_text() for text in legend.get_texts()] if legend is not None else []
        assert len(names) == len(set(names))
        assert [bool(axis.get_xlabel()) for axis in axes] == [False, True]
        plt.close(figure)


def test_a_design_that_is_not_certain_shows_it():
    design = at.tune(at.reduce(at.example("ball")), noise_gain=0.1, certificate=False)
    said = "not certain: the points allow more plants than the fitted plant does"
    assert "not certain" not in design._repr_html_()
    assert said in replace(design, certificate=f"margins hold; {said}")._repr_html_()


def test_what_has_no_standard_deviation_shows_none():
    online = at.delay(at.example("oven"), method="online")
    rows = {row[0]: row[2] for row in at.to_pandas(online).to_numpy()}
    assert rows["constant"] is None or math.isnan(rows["constant"])
    assert rows["b"] > 0.0


def test_a_remark_stands_once_over_the_whole_width_and_a_real_pole_without_imaginary_part():
    loop = at.closed_loop(at.example("loop"), order=5)
    shown = loop._repr_html_()
    assert shown.count("not excited enough") == 1
    printed = str(loop).splitlines()
    assert printed[0] == "Plant of order 5 from its loop"
    assert len(printed) <= 10
    assert shown.count("<td colspan=") == len({loop.excitation.sentence, *loop.warnings})
    assert "+0i" not in shown
    assert len(at.to_pandas(loop).columns) == 3


def test_each_papers_main_result_takes_a_few_lines():
    """The PI on the reduced model of (23) and criterion (10); the dead time of Example 2; the poles of the loop."""
    ball = at.example("ball")
    design = at.tune(at.reduce(ball), noise_gain=0.1)
    assert design.h2 == pytest.approx(58.13, rel=0.03)
    assert at.validate(ball, at.reduce(ball), at.PI(K=-0.023, Ti_s=3.0)).holds
    found = at.delay(at.example("delay"))
    assert found.delay_s == pytest.approx(4.0, abs=5.0 * found.standard_deviations[3])
    loop = at.closed_loop(at.example("loop"), order=5, method="indirect")
    assert np.abs(loop.poles - (0.9681 + 0.1486j)).min() < 0.05


def test_a_model_with_its_operating_point_simulates_the_recording():
    from autotune.models import Block, Model, Port

    oven, plant = at.example("oven"), at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0), delay_s=0.5)
    model = Model(
        name="oven", input=Port(unit="kW", offset=5.0), output=Port(unit="degC", offset=50.0),
        blocks=(Block(name="oven", place="plant", dynamics=plant),),
    )  # fmt: skip
    simulated = at.simulate(model, oven)
    assert np.std(simulated - oven.y) < 0.05


def test_a_stated_control_law_reaches_the_diagnosis_of_equations(tmp_path):
    file, gain = tmp_path / "tank.toml", 2.0
    file.write_text(
        'name = "tank"\n[[input]]\ncolumn = "u"\n[output]\nvalue = "h"\n[[state]]\nname = "h"\nkind = "level"\n'
        'derivative = "(K*u - h)/T"\n[parameters.K]\nvalue = 1.0\n[parameters.T]\nvalue = 5.0\n'
    )
    random, t = np.random.default_rng(3), 0.5 * np.arange(600)
    r, u, y, h = np.repeat(random.normal(1.0, 0.3, 30), 20), np.empty(600), np.empty(600), 0.0
    for k in range(600):
        y[k] = h + 0.002 * random.normal()
        u[k] = gain * (r[k] - y[k])
        h += (u[k] - h) * (1.0 - np.exp(-0.1))
    recording = at.read({"t": t, "u": u, "y": y, "r": r})
    other = at.TransferFunction(num=(3.0 * gain,), den=(1.0,))
    assert "controller.law" in [e["name"] for e in at.diagnose(file, recording, other).as_json()["effects"]]
    same = at.diagnose(file, recording, at.TransferFunction(num=(gain,), den=(1.0,)))
    for shown in (str(same), repr(same)):
        assert shown.startswith("Verdict: ")
        assert all(sentence in shown for sentence in same.sentences)
        assert len(shown) < 3000
    assert same.verdict == "none"
