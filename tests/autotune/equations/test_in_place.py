"""Compiled functions that own nothing count no references, and still run where Numba has no such option."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from autotune.arrays import FloatArray
from autotune.equations import compile_model, switching
from autotune.equations import in_place as module
from autotune.equations import work as room
from tests.autotune.equations.models import one_state


class Pair(NamedTuple):
    a: FloatArray
    b: FloatArray


def _add(pair: Pair) -> None:
    for i in range(pair.a.size):
        pair.b[i] += pair.a[i]


def test_no_references_are_counted_where_derivatives_are_evaluated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(module.COMPILED, "cache", False)
    compiled = compile_model(one_state("x", {"a": 2.0}, state=[{"name": "x", "derivative": "u - a*x^3"}]))
    p = compiled.program.tape()
    work = room.new_work(p, compiled.program.registers, compiled.parameter_vector)
    for make, counts in ((module.in_place, False), (numba.njit, True)):
        field = make(switching.field_in_row.py_func)
        field(p, work, np.array([0.5]), 0.0)
        assert work.K[0, 0] == pytest.approx(-0.25)
        assert ("call void @NRT_incref" in field.inspect_llvm(field.signatures[0])) is counts


def test_without_the_option_it_is_compiled_as_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(**options: Any) -> Any:
        if "_nrt" in options:
            raise KeyError("Unrecognized options: {'_nrt'}")
        return numba.njit(**options)

    monkeypatch.setattr(module, "njit", refusing)
    monkeypatch.setitem(module.COMPILED, "cache", False)
    pair = Pair(np.arange(4.0), np.ones(4))
    module.in_place(_add)(pair)
    np.testing.assert_array_equal(pair.b, 1.0 + np.arange(4.0))
