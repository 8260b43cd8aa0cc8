"""The control law recomputed from r and y, on loops that run here by their difference equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from autotune.controller import Controller, DiscreteController, PIDController
from autotune.design.law import PILaw
from autotune.diagnosis.evidence.law import law_effect, shown_law, stated_law
from autotune.models import TransferFunction
from autotune.recording import Recording

STATED = PIDController(K=0.8, Ti_s=2.0)


def loop(gain: float, rows_before: int, noise: float = 0.02) -> Recording:
    """PI of ``gain`` times the stated K on a lag of 1 s, its command computed ``rows_before`` samples ahead."""
    rng, dt, rows = np.random.default_rng(4), 0.02, 3000
    r = np.where(np.arange(rows) // 300 % 2 == 0, 1.0, 2.0)
    x, integral, u, y, e = 0.0, 0.0, np.zeros(rows), np.zeros(rows), np.zeros(rows)
    for k in range(rows):
        y[k] = x + noise * rng.standard_normal()
        e[k] = r[k] - y[k]
        if k >= rows_before:
            known = e[k - rows_before]
            integral += 0.5 * dt * (known + (e[k - rows_before - 1] if k > rows_before else known))
            u[k] = gain * STATED.K * (known + integral / STATED.Ti_s) + 0.01 * rng.standard_normal()
        x += (1.0 - np.exp(-dt)) * (u[k] - x)
    return Recording(t=dt * np.arange(rows), u=u, y=y, extra={"r": r})


@pytest.mark.parametrize("rows_before", [0, 1])
def test_a_law_that_is_as_stated_is_left_alone_whichever_sample_its_command_came_from(rows_before: int) -> None:
    assert law_effect([loop(1.0, rows_before)], STATED) is None


@pytest.mark.parametrize("rows_before", [0, 1])
def test_another_gain_is_found_with_its_size(rows_before: int) -> None:
    found = law_effect([loop(1.3, rows_before)], STATED)
    assert found is not None
    factor = found.parameters["gain_factor"]
    assert abs(factor.value - 1.3) < 4.0 * factor.sd


def loop_under(law: PIDController, Ts: float = 0.01, dither: float = 0.0) -> Recording:
    """The law that a rig is given, on a lag of 1 s, its set-point moved in steps."""
    rng, rows = np.random.default_rng(7), 3000
    r = np.where(np.arange(rows) // 400 % 2 == 0, 1.0, 2.0)
    wave = dither * np.sin(2.0 * np.pi * 0.8 * Ts * np.arange(rows))
    runs = PILaw(controller=law, sample_time_s=Ts)
    state, x, u, y = runs.initial(0.0, 1.0, 0.0), 0.0, np.zeros(rows), np.zeros(rows)
    for k in range(rows):
        y[k] = x + 0.01 * rng.standard_normal()
        u[k], state = runs.step(state, float(r[k]), float(y[k]))
        u[k] += wave[k]
        x += (1.0 - np.exp(-Ts)) * (u[k] - x)
    return Recording(t=Ts * np.arange(rows), u=u, y=y, extra={"r": r})


PD = PIDController(K=1.5, Ti_s=np.inf, Td_s=0.1, Tf_s=0.02)
PID = PIDController(K=1.2, Ti_s=1.5, Td_s=0.1, Tf_s=0.02, setpoint_weight=0.6)


@pytest.mark.parametrize("law", [PD, PID, PIDController(K=1.2, Ti_s=1.5, Tf_s=0.1)])
def test_every_law_of_a_controller_file_is_recomputed_with_its_filter_and_its_set_point_weight(
    law: PIDController,
) -> None:
    r = loop_under(law)
    assert law_effect([r], law) is None
    found = law_effect([r], replace(law, K=law.K / 1.3))
    assert found is not None
    assert found.parameters["gain_factor"].value == pytest.approx(1.3, abs=0.03)


@pytest.mark.parametrize("dither", [0.0, 0.3])
def test_a_derivative_whose_filter_a_sidecar_does_not_state_is_recomputed(dither: float) -> None:
    r = loop_under(PD, dither=dither)
    stated = {"controller": {"kind": "PD", "K": PD.K, "T_d": PD.Td_s}}
    assert law_effect([replace(r, metadata=stated)]) is None
    for key, value, factor, least in (("K", 1.1, "gain_factor", 1.3), ("T_d", 0.07, "T_d_factor", 1.1)):
        other = {"controller": {**stated["controller"], key: value}}
        found = law_effect([replace(r, metadata=other)])
        assert found is not None
        assert least < found.parameters[factor].value < 1.45  # of T_d the filter may take its share


@pytest.mark.parametrize(
    "law",
    [
        TransferFunction(num=(PD.K * (PD.Tf_s + PD.Td_s), PD.K), den=(PD.Tf_s, 1.0)),
        DiscreteController(num=(1.2, -1.192), den=(1.0, -1.0), sample_time_s=0.01),
    ],
)
def test_a_law_given_as_polynomials_is_recomputed_as_a_whole(law: TransferFunction | DiscreteController) -> None:
    """K (1 + T_d s/(1 + T_f s)) held by the recorded command, and a PI by differences: their gains are shown."""
    rng, Ts = np.random.default_rng(2), 0.01
    e = np.repeat(rng.standard_normal(300), 10) + 0.01 * rng.standard_normal(3000)
    r = Recording(t=Ts * np.arange(3000), u=1.4 * answer(law, e, Ts) + 0.5, y=1.0 - e, extra={"r": np.ones(3000)})
    found = law_effect([r], law)
    assert found is not None
    assert found.parameters["gain_factor"].value == pytest.approx(1.4, rel=0.02)
    assert law_effect([replace(r, u=(r.u - 0.5) / 1.4)], law) is None


def answer(law: Controller, e: np.ndarray, Ts: float) -> np.ndarray:
    """What a law makes of an error sample by sample, by backward differences where it is given in s."""
    match law:
        case DiscreteController():
            return np.asarray(lfilter(law.num, law.den, e))
        case _:
            rate, keep = np.diff(e, prepend=e[0]) / Ts, PD.Tf_s / (PD.Tf_s + Ts)
            return np.asarray(PD.K * (e + PD.Td_s * lfilter([1.0 - keep], [1.0, -keep], rate)))


def test_what_cannot_be_recomputed_says_nothing() -> None:
    r = loop_under(PD)
    other_clock = DiscreteController(num=(1.0,), den=(1.0,), sample_time_s=0.02)
    improper = TransferFunction(num=(0.1, 1.0), den=(1.0,))
    for law in (other_clock, improper, replace(PD, K=0.0)):
        known = stated_law({}, law)
        assert known is not None
        assert shown_law(r, known) is None
    assert stated_law({"controller": {"kind": "relay", "half_amplitude": 1.0}}, None) is None
