"""Nothing is taken silently: words are checked at the door, and every failure is one of the project's own."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st
from typing_extensions import TypeAliasType

import autotune as at
from autotune.arguments import check_arguments
from autotune.errors import AutotuneError, InputError
from autotune.points import FrequencyPoint

PLANT = at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0), delay_s=0.5)


def points(gain: float = 1.0) -> list[FrequencyPoint]:
    """Five exact points of the plant."""
    omega = np.array([0.5, 0.7, 0.9, 1.1, 1.4])
    sd = 1e-3 * gain
    return [
        FrequencyPoint(omega_rad_s=float(w), response=complex(gain * h), covariance=((sd**2, 0.0), (0.0, sd**2)))
        for w, h in zip(omega, PLANT.response(omega), strict=True)
    ]


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: at.delay(at.example("oven"), method="algebriac"), "'algebraic'"),
        (lambda: at.delay(at.example("oven"), delays=3), "delays = 3"),
        (lambda: at.delay(at.example("oven"), max_dealy_s=1.0), "'max_delay_s'"),
        (lambda: at.delay(at.example("oven"), order=2.5), "whole number"),
        (lambda: at.delay(at.example("oven"), order="two"), "order = 'two'"),
        (lambda: at.delay(at.example("oven"), interval_s=-1.0, method="algebraic"), "interval_s = -1.0"),
        (lambda: at.tune(PLANT, kind="banana"), "kind = 'banana'"),
        (lambda: at.tune(PLANT, kind=None), "kind = None"),
        (lambda: at.tune(PLANT, noise_gian=1.0), "'noise_gain'|no setting"),
        (lambda: at.tune(PLANT, criterion="iea"), "'iae'"),
        (lambda: at.tune(PLANT, noise_gain="much"), "noise_gain = 'much'"),
        (lambda: at.tune(PLANT, modulus_margin=math.nan), "modulus_margin = nan"),
        (lambda: at.reduce(points(), kind="banana"), "kind = 'banana'"),
        (lambda: at.reduce(points(), conditions="region"), "'regions'"),
        (lambda: at.reduce(points(), knid="integrating"), "'kind'"),
        (lambda: at.reduce(PLANT, kind="integrating"), "no setting 'kind'"),
        (lambda: at.closed_loop(at.example("loop"), method="indirekt"), "'indirect'"),
        (lambda: at.closed_loop(at.example("loop"), max_ordre=3), "'max_order'"),
        (lambda: at.PI(K=math.nan, Ti_s=1.0), "K = nan"),
        (lambda: at.PI(K=1.0, Ti_s=0.0), "Ti_s = 0"),
        (lambda: at.PI(K=1.0, Ti_s=1.0, Td_s=-1.0), "Td_s = -1"),
        (lambda: at.tune(at.TransferFunction(num=(1.0, 0.0, 1.0), den=(1.0, 1.0))), "no plant differentiates"),
        (lambda: at.margins(PLANT, at.PI(K=0.0, Ti_s=0.0)), "no loop"),
        (lambda: at.margins(PLANT, at.PI(K=1.0, Ti_s=1e-320)), "other units"),
        (lambda: at.margins(PLANT, at.PI(K=1e300, Ti_s=1e300)), "range of numbers"),
        (lambda: at.margins(PLANT, at.PI(K=1e-300, Ti_s=1e-300)), "range of numbers"),
        (lambda: at.validate(PLANT, PLANT, at.PI(K=1.0, Ti_s=1.0), scaling=0.0), "scaling = 0.0"),
    ],
)
def test_what_is_not_known_is_refused_with_what_is(call: Any, named: str) -> None:
    with pytest.raises(InputError, match=named):
        call()


#: what fails is told as it was found: shrinking a design takes minutes
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)
NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.0, -1.0, 1e-320, 1e300, math.nan, math.inf, 0.5, 1.0, 45.0]),
)
COEFFICIENTS = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=4)
ANY = st.one_of(NUMBERS, st.none(), st.text(max_size=8), st.lists(st.integers(), max_size=3), st.just(PLANT))


def _tried(call: Any) -> Any:
    """Return what a call gives; an error of the project's own is an answer, every other one fails the test."""
    try:
        return call()
    except AutotuneError:
        return None


@settings(max_examples=25, phases=PHASES, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(num=COEFFICIENTS, den=COEFFICIENTS, delay_s=NUMBERS, K=NUMBERS, Ti_s=NUMBERS)
@example(num=[0.0044, 4e5], den=[0.0044, 4e5], delay_s=3e16, K=1e-320, Ti_s=1e-320)
@example(num=[-7e5, -9e5], den=[4e5, -1.0, 8.0], delay_s=1e6, K=0.5, Ti_s=1.4e-120)
def test_margins_of_any_plant_and_controller(num: Any, den: Any, delay_s: Any, K: Any, Ti_s: Any) -> None:
    found = _tried(
        lambda: at.margins(at.TransferFunction(num=tuple(num), den=tuple(den), delay_s=delay_s), at.PI(K=K, Ti_s=Ti_s))
    )
    assert found is None or isinstance(found.stable, bool)


@settings(max_examples=10, phases=PHASES, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(num=COEFFICIENTS, den=COEFFICIENTS, delay_s=st.floats(0.0, 10.0), noise=NUMBERS, modulus=NUMBERS, kind=ANY)
def test_a_design_on_any_plant(num: Any, den: Any, delay_s: Any, noise: Any, modulus: Any, kind: Any) -> None:
    def designed() -> Any:
        plant = at.TransferFunction(num=tuple(num), den=tuple(den), delay_s=delay_s)
        return at.tune(plant, noise_gain=noise, modulus_margin=modulus, kind=kind, certificate=False)

    found = _tried(designed)
    assert found is None or found.margins.stable


@settings(max_examples=15, phases=PHASES, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(source=ANY, other=ANY, name=st.text(max_size=6), value=ANY)
def test_anything_at_all(source: Any, other: Any, name: str, value: Any) -> None:
    calls = [
        lambda: at.tune(source, noise_gain=other),
        lambda: at.tune(PLANT, certificate=False, **{name: value}),
        lambda: at.reduce(source, **{name: value}),
        lambda: at.margins(source, other),
        lambda: at.validate(source, other, value),
        lambda: at.delay(source, other, method=value),
        lambda: at.closed_loop(source, other, method=value),
        lambda: at.simulate(source, other, horizon_s=value),
        lambda: at.read(source),
        lambda: at.to_pandas(source),
    ]
    for call in calls:
        _tried(call)


def test_points_go_to_python_control_and_back_through_tune() -> None:
    pytest.importorskip("control")
    system = at.to_control(at.Points(points()))
    found = at.tune(system, noise_gain=10.0)
    assert at.margins(PLANT, found).modulus >= 0.495


@pytest.mark.parametrize("unit", [1e-3, 50.0])
def test_without_a_noise_gain_no_unit_of_y_changes_a_design(unit: float) -> None:
    """The default is a share of the plant's own gain; a number would have been in somebody's units."""
    plant = at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0))
    scaled = at.TransferFunction(num=(2.0 * unit,), den=(6.0, 5.0, 1.0))
    own, other = (at.tune(one, certificate=False).controller for one in (plant, scaled))
    assert other.K * unit == pytest.approx(own.K, rel=1e-2)
    assert other.Ti_s == pytest.approx(own.Ti_s, rel=1e-2)
    assert at.validate(scaled, at.reduce(scaled)).holds == at.validate(plant, at.reduce(plant)).holds


def test_a_table_is_of_numbers_with_all_of_their_digits() -> None:
    pytest.importorskip("pandas")
    m = at.margins(PLANT, at.PI(K=0.5, Ti_s=4.0))
    frame = at.to_pandas(m)
    assert frame.iloc[0, 1] == m.modulus
    assert frame.iloc[6, 1] == m.h2


def test_an_alias_stands_for_the_type_that_it_names() -> None:
    # what numpy's NDArray is from 2.5 on, on Python 3.12 and newer
    row_of_numbers = TypeAliasType("row_of_numbers", np.ndarray[Any, np.dtype[np.float64]])

    def largest(values: Any) -> float:
        return float(values.max())

    largest.__annotations__["values"] = row_of_numbers
    assert check_arguments(largest)([1, 3, 2]) == 3.0
    with pytest.raises(InputError, match="finite numbers in a row"):
        check_arguments(largest)("many")
