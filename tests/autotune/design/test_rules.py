"""Tuning rules and pole placement: their authors' formulas, and what of the paper's RST row can be rebuilt."""

from __future__ import annotations

import math

import numpy as np
import pytest

from autotune.design.margins import margins
from autotune.design.rst import comparison_rst, place_poles
from autotune.design.rules import half_rule, simc, step_response_model
from autotune.design.specification import Specification
from autotune.design.synthesis import design
from autotune.errors import DesignError
from autotune.models import TransferFunction
from tests.autotune.design.plants import BALL, EIGHT_LAGS, FOPDT
from tests.autotune.design.tuning_rules import (
    RULES,
    relay_ultimate_point,
    tyreus_luyben,
    ultimate_point,
    ziegler_nichols,
)

THREE_LAGS = TransferFunction(num=(1.0,), den=(1.0, 3.0, 3.0, 1.0))


def test_ultimate_point_of_three_equal_lags() -> None:
    K_u, T_u = ultimate_point(THREE_LAGS)
    assert K_u == pytest.approx(8.0)
    assert T_u == pytest.approx(2.0 * math.pi / math.sqrt(3.0))
    assert pytest.approx(3.6) == ziegler_nichols(THREE_LAGS).K
    assert tyreus_luyben(THREE_LAGS).Ti_s == pytest.approx(2.2 * T_u)


def test_ultimate_gain_of_the_ball_carries_its_sign() -> None:
    K_u, T_u = ultimate_point(BALL)
    assert K_u < 0.0
    assert 2.0 * math.pi / T_u == pytest.approx(11.6817, abs=5e-4)


def test_relay_limit_cycle_of_a_lag_with_dead_time_is_the_textbooks() -> None:
    # half period T ln(2 exp(L/T) - 1), amplitude 1 - exp(-L/T), for L = T = 1
    K_u, T_u = relay_ultimate_point(FOPDT)
    assert T_u == pytest.approx(2.0 * math.log(2.0 * math.e - 1.0), rel=1e-3)
    assert K_u == pytest.approx(4.0 / (math.pi * (1.0 - math.exp(-1.0))), rel=2e-3)
    # the describing function's error against the true ultimate gain
    assert 0.85 < K_u / ultimate_point(FOPDT)[0] < 0.95


def test_half_rule_example_of_its_author() -> None:
    # Skogestad 2003, example E1: 1/((s + 1)(0.2 s + 1)) gives T = 1.1, theta = 0.1, K = 5.5, T_I = 0.8
    plant = TransferFunction(num=(1.0,), den=(0.2, 1.2, 1.0))
    m = half_rule(plant)
    assert (m.T_s, m.L_s) == pytest.approx((1.1, 0.1))
    assert pytest.approx(5.5) == simc(plant).K
    assert simc(plant).Ti_s == pytest.approx(0.8)


def test_step_response_model_of_a_lag_with_dead_time_is_itself() -> None:
    m = step_response_model(FOPDT)
    assert (m.gain, m.T_s, m.L_s) == pytest.approx((1.0, 1.0, 1.0), rel=1e-3)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("plant", [BALL, FOPDT, EIGHT_LAGS], ids=["ball", "lag and dead time", "eight lags"])
def test_design_does_not_lose_to_a_rule_under_the_rules_own_margins(rule: str, plant: TransferFunction) -> None:
    controller = RULES[rule](plant)
    m = margins(plant, controller)
    if not m.stable:
        assert plant is BALL  # Ziegler-Nichols' PI leaves this integrating plant unstable
        return
    asked = Specification(
        modulus_margin=m.modulus,
        phase_margin_rad=min(m.phase_rad, math.radians(89.9)),
        noise_gain=m.noise_gain_bound * (1.0 + 1e-9),
    )
    assert design(plant, asked, certificate=False).h2 <= m.h2 * (1.0 + 1e-5)


def test_a_plant_without_phase_lag_has_no_ultimate_point() -> None:
    with pytest.raises(DesignError, match="-180"):
        ultimate_point(TransferFunction(num=(1.0,), den=(1.0, 1.0)))


@pytest.mark.parametrize("gain", [1.0, 1e-15, -1e15])
def test_poles_land_where_they_are_placed_in_all_units(gain: float) -> None:
    poles = [-1.0, -2.0, -3.0 + 1.0j, -3.0 - 1.0j, -5.0]
    plant = TransferFunction(num=(2.0 * gain, 3.0 * gain), den=(1.0, 1.0, 4.0))
    controller = place_poles(plant, poles)
    closed = np.polyadd(np.polymul(plant.den, controller.S), np.polymul(plant.num, controller.R))
    np.testing.assert_allclose(np.sort_complex(np.roots(closed)), np.sort_complex(np.array(poles)), rtol=1e-6)
    assert controller.S[-1] == 0.0


def test_row_rst_of_table_two_can_be_rebuilt_but_for_its_norm() -> None:
    # paper: fifth order, dominant pole -1.8 rad/s, M_m 0.6, 45 degrees, N_max 0.1, M_ret 0.38, omega_gc 2.05, H2 4.25
    controller = comparison_rst(BALL)
    assert len(controller.S) - 1 == 5
    m = margins(BALL, controller.feedback())
    assert m.stable
    assert m.modulus == pytest.approx(0.6, abs=0.02)
    assert math.degrees(m.phase_rad) == pytest.approx(45.0, abs=0.6)
    assert m.delay_s == pytest.approx(0.38, abs=0.01)
    assert m.crossover_rad_s == pytest.approx(2.05, abs=5e-3)
    assert m.noise_gain == pytest.approx(0.1, abs=3e-3)
    # the printed norm cannot be had with that row: 29.8 here
    assert m.h2 == pytest.approx(29.83, abs=0.01)


def test_static_gain_from_set_point_to_output_is_one() -> None:
    controller = comparison_rst(BALL)
    assert controller.prefilter().response(np.array([1e-9]))[0] == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(
    ("plant", "poles"),
    [(FOPDT, [-1.0] * 3), (THREE_LAGS, [-1.0] * 3), (THREE_LAGS, [1.0] * 7)],
    ids=["dead time", "too few", "unstable"],
)
def test_impossible_placements_are_refused(plant: TransferFunction, poles: list[complex]) -> None:
    with pytest.raises(DesignError):
        place_poles(plant, poles)
