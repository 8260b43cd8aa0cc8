"""Machine code of a tape computes what its operations compute, to the last bit, and is made where it is worth it."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from autotune.arrays import FloatArray
from autotune.equations import compile_model, opcodes, simulate
from autotune.equations.native import Native, Translator, call
from autotune.equations.simulate import Drive
from autotune.equations.tape_ops import evaluate
from tests.autotune.equations.models import one_state

OPERATIONS = sorted({v for k, v in vars(opcodes).items() if k.isupper() and isinstance(v, int)})
#: Each on registers 0 to 2, then each on what the one before it gave.
CODE = np.array(
    [[o, 3 + k, 0, 1, 2] for k, o in enumerate(OPERATIONS)]
    + [[o, 3 + len(OPERATIONS) + k, 3 + (k - 1) % len(OPERATIONS), 2, 0] for k, o in enumerate(OPERATIONS)]
)
NATIVE = Native(CODE, 0, len(CODE))
VALUES = st.one_of(
    st.floats(width=64, allow_subnormal=False),
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.5, 2.0, -3.0, 710.0, -2.5, np.inf, -np.inf, np.nan]),
)


@njit
def _run(address: int, r: FloatArray, extended: bool) -> None:
    call(address, r, extended)


@settings(max_examples=300, deadline=None)
@given(st.tuples(VALUES, VALUES, VALUES), st.booleans())
def test_every_operation_gives_the_same_bits(values: tuple[float, float, float], extended: bool) -> None:
    read, translated = np.zeros(3 + len(CODE)), np.zeros(3 + len(CODE))
    read[:3] = translated[:3] = values
    evaluate(CODE, 0, len(CODE), read, extended)
    _run(NATIVE.address, translated, extended)
    np.testing.assert_array_equal(translated, read)
    known = ~np.isnan(read)
    np.testing.assert_array_equal(np.signbit(translated[known]), np.signbit(read[known]))


def test_a_tape_is_translated_once_it_has_run_over_many_rows_and_forgotten_after_others() -> None:
    ask = Translator(worth=1000, remembered=2).native
    assert ask(CODE, 0, 5, 600) is None
    first = ask(CODE, 0, 5, 600)
    assert first is not None
    assert ask(CODE, 0, 5, 1) is first
    assert ask(CODE, 0, 6, 600) is None  # another tape counts for itself
    for last in (6, 7, 8):
        ask(CODE, 0, last, 2000)
    assert ask(CODE, 0, 5, 600) is None


@pytest.mark.parametrize("derivative", ["u - a*abs(x)*x", "u - a*sign(x)", "sqrt(max(u + x, 0)) - a*x^3"])
def test_a_simulation_is_the_same_before_and_after_its_tape_is_translated(
    derivative: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = compile_model(one_state("x", {"a": 2.0}, state=[{"name": "x", "derivative": derivative}]))
    t = np.arange(400) * 0.05
    drive = Drive(t=t, inputs=np.sign(np.sin(0.7 * t))[:, None])
    found = []
    for worth in (10**9, 0):
        monkeypatch.setattr(import_module("autotune.equations.simulate"), "_TRANSLATOR", Translator(worth=worth))
        run = simulate(compiled, compiled.parameter_vector, drive, np.array([0.3]))
        found.append((run.outputs, run.ends, run.steps))
    for read, translated in zip(*found, strict=True):
        np.testing.assert_array_equal(translated, read)
