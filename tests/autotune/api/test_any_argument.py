"""Every public function over arguments of every kind: an answer, or an error of the project's own."""

from __future__ import annotations

import contextlib
import inspect
import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

import autotune as at
from autotune.errors import AutotuneError

PLANT = at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0))
SQUARE = np.sign(np.sin(np.arange(60) / 5))
SHORT = at.read({"t": np.arange(60) / 10, "u": SQUARE, "y": lfilter([0.0, 0.1], [1.0, -0.9], SQUARE)})
POINTS = at.Points(at.frequency_points(at.example("oven"), largest_relative_sd=0.05))
#: what a function takes for its first argument
FIRST: dict[str, Any] = {
    "tune": PLANT, "reduce": PLANT, "margins": PLANT, "validate": PLANT, "transition": PLANT, "rst": PLANT,
    "delay": SHORT, "closed_loop": SHORT, "frequency_points": SHORT, "simulate": at.Model.from_text("2/(3s+1)"),
    "diagnose": at.Model.from_text("2/(3s+1)"), "read": SHORT, "plot": PLANT, "to_control": PLANT,
    "from_control": PLANT, "to_pandas": SHORT, "example": "oven", "read_model": "no.toml",
    "read_controller": "no.toml", "OnlineEstimator": 2, "PI": None, "Points": [], "Recording": None,
    "TransferFunction": None,
}  # fmt: skip
#: what takes settings of another function besides its own
WITH_SETTINGS = ("reduce", "tune", "delay", "closed_loop", "diagnose", "frequency_points")
VALUES: list[Any] = [
    None, True, 0, -1, 3, 10**400, 0.0, -0.5, 0.5, 1e-320, 1e300, math.nan, math.inf, -math.inf, 1j, "", "pi", "x\x00y",
    "\ud800", b"bytes", [], [1], [math.nan, 1.0], (), (1.0,), {}, {"t": [0.0]}, {"t": [1, 0], "u": [1, 2], "y": [1]},
    np.array([]), np.zeros((2, 2)), np.array(["a"]), np.array([1.0, np.nan]), object(), int, len, PLANT, SHORT, POINTS,
    at.PI(K=1.0, Ti_s=2.0), [SHORT, None], [PLANT], "no such file.csv", "no such file.toml", "/", "closed_loop.json",
]  # fmt: skip
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)


def _parameters(name: str) -> list[str]:
    """Return the names that a public function or class may be given values by."""
    value = getattr(at, name)
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return [p.name for p in inspect.signature(value).parameters.values() if p.kind in kinds]


def examples(count: int) -> settings:
    """Return how many arguments of a function are tried: so many, or what the environment asks for."""
    return settings(
        max_examples=int(os.environ.get("ANY_EXAMPLES", count)),
        phases=PHASES,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
        derandomize=True,
    )


@pytest.mark.parametrize("name", sorted(set(at.__all__) - {"Model", "diagnose"}))
@examples(40)
@given(data=st.data())
def test_a_public_function_answers_or_refuses(name: str, data: st.DataObject) -> None:
    names = _parameters(name)
    chosen = data.draw(st.sets(st.sampled_from(names), max_size=3)) if names else set()
    given_ = {key: data.draw(st.sampled_from(VALUES), label=key) for key in sorted(chosen)}
    first = FIRST[name]
    call = getattr(at, name)
    if names and names[0] not in given_ and first is not None:
        given_[names[0]] = first
    required = {
        p.name for p in inspect.signature(call).parameters.values()
        if p.default is inspect.Parameter.empty and p.name in names
    }  # fmt: skip
    for key in required - set(given_):  # what Python itself asks for
        given_[key] = data.draw(st.sampled_from(VALUES), label=key)
    with contextlib.suppress(AutotuneError):
        call(**given_)


CHAIN = at.Model.from_text("2/(3s+1)")
#: settings of functions, and arguments of what hangs on public classes
FURTHER: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "tune": (
        lambda **more: at.tune(PLANT, **{"noise_gain": 1.0, "certificate": False, **more}),
        ("noise", "noise_frequency_rad_s", "delay_margin_s", "setpoint_command", "criterion"),
    ),
    "reduce": (lambda **more: at.reduce(POINTS, **more), ("kind", "conditions", "static_gain", "fit")),
    "delay": (
        lambda **more: at.delay(SHORT, 1, **more),
        ("max_delay_s", "hold", "past_input", "start_s", "integrator", "offset", "coloured", "skip_missing", "start"),
    ),
    "algebraic": (lambda **more: at.delay(SHORT, 1, method="algebraic", **more), ("interval_s", "start_s", "hold")),
    "online": (lambda **more: at.delay(SHORT, 1, method="online", **more), ("forgetting", "start_s", "hold")),
    "two delays": (lambda **more: at.delay(SHORT, delays=2, **more), ("start_s", "iterations", "polish")),
    "closed_loop": (
        lambda **more: at.closed_loop(SHORT, 1, **more), ("delay", "max_order", "omega_rad_s", "limits", "controller")
    ),
    "diagnose": (lambda **more: at.diagnose(CHAIN, SHORT, **more), ("without", "thresholds", "controller")),
    "frequency_points": (lambda **more: at.frequency_points(SHORT, **more), ("t", "u", "y", "r", "name")),
    "Model.from_equations": (at.Model.from_equations, ("content", "name")),
    "Model.from_control": (at.Model.from_control, ("system", "name")),
    "Model.from_text": (at.Model.from_text, ("text", "name")),
    "Model.from_function": (
        lambda **more: at.Model.from_function(**{"step": len, "state": 0, "parameters": {}, **more}),
        ("step", "state", "parameters", "columns", "name"),
    ),
    "Recording.between": (lambda **more: SHORT.between(**{"start_s": 0.0, "end_s": 3.0, **more}), ("start_s", "end_s")),
    "Recording.only": (SHORT.only, ("keep",)),
    "Recording.resampled": (SHORT.resampled, ("dt_s",)),
    "Recording.require_finite": (SHORT.require_finite, ("columns",)),
    "RST.law": (
        lambda **more: at.rst(PLANT, dominant_rad_s=1.0, rest_rad_s=2.0).law(**{"sample_time_s": 0.01, **more}),
        ("sample_time_s", "u_min", "u_max"),
    ),
    "OnlineEstimator.step": (
        lambda **more: at.OnlineEstimator(1, forgetting=1.0).step(**{"t": 0.0, "u": 0.0, "y": 0.0, **more}),
        ("t", "u", "y"),
    ),
    "OnlineEstimator.run": (
        lambda **more: at.OnlineEstimator(1, forgetting=1.0).run(**{"t": [0.0], "u": [0.0], "y": [0.0], **more}),
        ("t", "u", "y"),
    ),
}  # fmt: skip
NEEDED = {"Model.from_equations": "content", "Model.from_control": "system", "Model.from_text": "text",
          "Recording.only": "keep", "Recording.resampled": "dt_s"}  # fmt: skip


@pytest.mark.parametrize("name", sorted(FURTHER))
@examples(25)
@given(data=st.data())
def test_a_setting_or_a_method_answers_or_refuses(name: str, data: st.DataObject) -> None:
    call, names = FURTHER[name]
    chosen = data.draw(st.sets(st.sampled_from(names), max_size=2)) | {NEEDED.get(name, names[0])}
    with contextlib.suppress(AutotuneError):
        call(**{key: data.draw(st.sampled_from(VALUES), label=key) for key in sorted(chosen)})


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: at.diagnose(CHAIN, SHORT, witout=("sensor.lag",)), "'without'"),
        (lambda: at.diagnose(CHAIN, SHORT, without="sensor.lag"), "a list"),
        (lambda: at.frequency_points(SHORT, nmae="oven"), "'name'"),
        (lambda: at.frequency_points(SHORT, u="command"), "have their names"),
        (lambda: at.reduce(POINTS, static_gain="much"), "static_gain = 'much'"),
        (lambda: at.delay(SHORT, hold="liner"), "'linear'"),
        (lambda: at.delay(SHORT, integrator=1), "True or False"),
        (lambda: at.delay(SHORT, max_delay_s=math.inf), "finite"),
        (lambda: at.closed_loop(SHORT, max_order=2.5), "whole number"),
        (lambda: SHORT.resampled(0.0), "must be positive"),
        (lambda: SHORT.only(np.array([0.5])), "numbers of rows"),
    ],
)
def test_what_is_not_taken_is_named(call: Callable[[], Any], named: str) -> None:
    with pytest.raises(AutotuneError, match=named):
        call()


@pytest.mark.parametrize("name", WITH_SETTINGS)
def test_a_setting_that_does_not_exist_is_refused_by_name(name: str) -> None:
    more = {"recordings": SHORT} if name == "diagnose" else {}
    with pytest.raises(AutotuneError, match="nonesuch"):
        getattr(at, name)(FIRST[name], **more, nonesuch=1.0)


@settings(max_examples=60, phases=PHASES, deadline=None, derandomize=True)
@given(words=st.text(max_size=30), number=st.sampled_from(VALUES))
def test_models_from_any_text_or_file(words: str, number: Any) -> None:
    for call in (lambda: at.Model.from_text(words), lambda: at.Model.from_text(number), lambda: at.read_model(number)):
        with contextlib.suppress(AutotuneError):
            call()
