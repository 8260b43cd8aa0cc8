"""An extended model is handed out where it is as near as the nominal one and bounded where that is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from autotune.arrays import FloatArray
from autotune.diagnosis.safe_extension import FARTHER, safe_extension
from autotune.errors import InputError
from autotune.recording import Recording

Law = Callable[[FloatArray], FloatArray]


def recorded(law: Law) -> Recording:
    t = 0.1 * np.arange(400)
    u = np.sin(t)
    return Recording(t=t, u=u, y=law(u), name="r")


def as_it_is(law: Law, r: Recording) -> FloatArray:
    return law(r.u)


def linear(u: FloatArray) -> FloatArray:
    return u


def bent(u: FloatArray) -> FloatArray:
    return u + 0.3 * u**2


def explodes(u: FloatArray) -> FloatArray:
    """Return what suits every recorded command and runs away beyond."""
    return bent(u) * np.where(np.abs(u) > 1.2, 1e6, 1.0)


def breaks_off(u: FloatArray) -> FloatArray:
    if np.max(np.abs(u)) > 1.2:
        raise InputError("the simulation runs away", where="bent")
    return bent(u)


def farther(u: FloatArray) -> FloatArray:
    return 1.5 * u


def test_what_is_nearer_and_bounded_is_handed_out() -> None:
    assert safe_extension((bent, linear), linear, [recorded(bent)], as_it_is, comparable=True) is bent


@pytest.mark.parametrize("law", [explodes, breaks_off])
def test_what_runs_away_on_twice_the_range_is_not(law: Law) -> None:
    assert safe_extension((law, bent), linear, [recorded(bent)], as_it_is, comparable=True) is bent
    assert safe_extension((law,), linear, [recorded(bent)], as_it_is, comparable=True) is linear


def test_what_is_farther_from_the_recordings_than_the_nominal_model_is_not() -> None:
    assert safe_extension((farther,), linear, [recorded(linear)], as_it_is, comparable=True) is linear
    # a free run of what does not settle says nothing of how near it is
    assert safe_extension((farther,), linear, [recorded(linear)], as_it_is, comparable=False) is farther


def test_a_nominal_model_that_goes_as_far_sets_how_far_others_may_go() -> None:
    def far(u: FloatArray) -> FloatArray:
        return 2.0 * FARTHER * u

    assert safe_extension((far,), far, [recorded(far)], as_it_is, comparable=True) is far
    assert safe_extension((far,), linear, [recorded(linear)], as_it_is, comparable=False) is linear


def test_what_the_persons_own_physics_does_with_the_right_numbers_is_no_danger() -> None:
    """A pendulum of the right weight goes over its top on twice the command, and turns on."""

    def turns(u: FloatArray) -> FloatArray:
        return bent(u) * np.where(np.abs(u) > 1.2, 30.0, 1.0)

    def turns_too(u: FloatArray) -> FloatArray:
        return 0.98 * turns(u)

    def handed_out(*models: Law, retuned: Law | None = None) -> Law:
        return safe_extension(models, linear, [recorded(bent)], as_it_is, comparable=True, retuned=retuned)

    assert handed_out(turns, turns_too) is linear
    assert handed_out(turns, turns_too, retuned=turns_too) is turns
    assert handed_out(turns_too, retuned=turns_too) is turns_too
    assert handed_out(explodes, turns_too, retuned=turns_too) is turns_too
    assert handed_out(turns, retuned=farther) is linear  # farther off than the nominal one: it says nothing
    assert handed_out(breaks_off, retuned=breaks_off) is linear


def test_a_nominal_model_that_runs_away_sets_no_bound() -> None:
    """A levitating magnet leaves its gap whatever its numbers are: one run goes a thousand times as far as another."""

    def unstable(u: FloatArray) -> FloatArray:
        return bent(u) * np.where(np.abs(u) > 1.2, 1e3, 1.0)

    assert safe_extension((explodes,), unstable, [recorded(bent)], as_it_is, comparable=False) is explodes
    assert safe_extension((breaks_off,), unstable, [recorded(bent)], as_it_is, comparable=False) is breaks_off
