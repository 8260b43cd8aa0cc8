"""Every public function over arguments of every kind: an answer, or an error of the project's own."""

from __future__ import annotations

import contextlib
import inspect
import math
import os
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import autotune as at
from autotune.errors import AutotuneError

PLANT = at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0))
SHORT = at.read({"t": np.arange(60) / 10, "u": np.sign(np.sin(np.arange(60) / 5)), "y": np.cos(np.arange(60) / 7)})
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


@pytest.mark.parametrize("name", sorted(set(at.__all__) - {"Model", "diagnose"}))
@settings(
    max_examples=int(os.environ.get("ANY_EXAMPLES", "40")),
    phases=PHASES,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=True,
)
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


@pytest.mark.parametrize("name", WITH_SETTINGS)
def test_a_setting_that_does_not_exist_is_refused_by_name(name: str) -> None:
    more = {"recordings": SHORT} if name == "diagnose" else {}
    with pytest.raises((AutotuneError, TypeError), match="nonesuch"):
        getattr(at, name)(FIRST[name], **more, nonesuch=1.0)


@settings(max_examples=60, phases=PHASES, deadline=None, derandomize=True)
@given(words=st.text(max_size=30), number=st.sampled_from(VALUES))
def test_models_from_any_text_or_file(words: str, number: Any) -> None:
    for call in (lambda: at.Model.from_text(words), lambda: at.Model.from_text(number), lambda: at.read_model(number)):
        with contextlib.suppress(AutotuneError):
            call()
