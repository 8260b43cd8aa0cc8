"""Noise that is not white and accounts for what is left: a disturbance of its own, and rows that are late."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from autotune.diagnosis import diagnose
from autotune.diagnosis.evidence.own_noise import coloured_noise
from autotune.diagnosis.findings import said_by
from autotune.diagnosis.gathering import evidence_of
from autotune.diagnosis.thresholds import IN_USE
from autotune.diagnosis.verdict import judged
from autotune.effects import CATALOGUE
from autotune.models import Block, Model, Port, TransferFunction
from autotune.progress import quiet
from autotune.recording import Recording

STEP_S, TAU_S = 0.5, 20.0


def lag(gain: float = 1.9, tau_s: float = 22.0) -> Model:
    block = Block(name="process", place="plant", dynamics=TransferFunction(num=(gain,), den=(tau_s, 1.0)))
    return Model(name="process", input=Port(unit="V"), output=Port(unit="bar"), blocks=(block,))


def stirred(seed: int, memory_s: float, rows: int = 3000) -> Recording:
    """tau dx/dt = -x + 2 (u + d), d of first order with a memory, held over a sample: exact between samples."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 80 + 1), 80)[:rows]
    keeps = np.exp(-STEP_S / memory_s)
    d = lfilter([np.sqrt(1.0 - keeps**2)], [1.0, -keeps], 0.03 * rng.normal(size=rows))
    stays = np.exp(-STEP_S / TAU_S)
    x = lfilter([0.0, 2.0 * (1.0 - stays)], [1.0, -stays], u + d)
    return Recording(t=STEP_S * np.arange(rows), u=u, y=x + 0.004 * rng.normal(size=rows), name="r")


@pytest.mark.parametrize("memory_s", [2.0, 8.0])
def test_a_disturbance_that_goes_with_no_signal_of_the_rig_is_nothing_missing(memory_s: float) -> None:
    found = diagnose(lag(2.0, TAU_S), [stirred(1, memory_s)])
    assert (found.verdict, found.effects) == ("none", ())
    assert found.residual.reduced_chi2 > 2.0
    assert "goes with no signal of the rig" in " ".join(found.sentences)


def test_a_disturbance_of_its_own_rules_no_effect_out() -> None:
    """What it leaves open has the probability of the search: a part of the rows that says so contradicts nothing."""
    rest = [name for name in CATALOGUE if name not in ("actuator.backlash", "actuator.stiction")]
    evidence = evidence_of(lag(2.0, TAU_S), [stirred(1, 8.0)], None, rest, quiet, IN_USE)
    assert evidence.own is not None
    assert judged(evidence) == "none"
    assert 0.0 < said_by(evidence)["actuator.backlash"] < 0.5
    assert evidence.keeping({"actuator.backlash"}).search.chosen.names == ()


def test_wrong_numbers_are_told_beside_a_disturbance() -> None:
    found = diagnose(lag(1.5, 30.0), [stirred(2, 4.0)])
    assert found.verdict == "parameters"
    dynamics = found.extended_model.blocks[0].dynamics
    assert (dynamics.num[0], dynamics.den[0]) == (pytest.approx(2.0, rel=0.05), pytest.approx(TAU_S, rel=0.1))


def test_a_slow_path_from_the_command_is_no_disturbance() -> None:
    """A second, slow mode that is fed by the command: what is left is as slow, and goes with u."""
    recording = stirred(3, 4.0)
    stays = np.exp(-STEP_S / 150.0)
    crept = lfilter([0.0, 0.8 * (1.0 - stays)], [1.0, -stays], recording.u)
    found = diagnose(
        lag(2.0, TAU_S), [Recording(t=recording.t, u=recording.u, y=recording.y + crept, name="r")],
        without=("plant.slow_mode",),
    )  # fmt: skip
    assert not found.residual.accounted


def test_the_order_and_size_of_coloured_noise_are_found() -> None:
    rng = np.random.default_rng(4)
    e = lfilter([1.0], [1.0, -1.5, 0.7], rng.normal(size=20_000))
    noise = coloured_noise([e], [np.ones(e.size, dtype=bool)])
    assert noise.ar[:2] == pytest.approx((1.5, -0.7), abs=0.03)
    assert noise.sd == pytest.approx(1.0, rel=0.02)


def late_servo(seed: int, jitter_s: float, rows: int = 3000) -> Recording:
    """tau dv/dt = -v + 5 u, dx/dt = v under a P controller whose rows come late by a random time: exact between events.

    A row that is late reads late, and its command acts as late.
    """
    rng = np.random.default_rng(seed)
    tau, dt = 0.25, 0.02
    v = x = held = 0.0
    at = np.maximum.accumulate(dt * np.arange(rows) + jitter_s * rng.normal(size=rows))
    aim = np.repeat(rng.uniform(-1.0, 1.0, rows // 40 + 1), 40)[:rows]
    u, y = np.empty(rows), np.empty(rows)
    for k in range(rows):
        h = at[k] - (at[k - 1] if k else 0.0)
        keeps, final = np.exp(-h / tau), 5.0 * held
        x += final * h + (v - final) * tau * (1.0 - keeps)
        v = final + (v - final) * keeps
        y[k] = x + 0.002 * rng.normal()
        u[k] = held = 3.0 * (aim[k] - y[k])
    return Recording(t=dt * np.arange(rows), u=u, y=y, name="r")


def servo() -> Model:
    speed = Block(name="speed", place="plant", dynamics=TransferFunction(num=(5.0,), den=(0.25, 1.0)))
    position = Block(name="position", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0)))
    return Model(name="servo", input=Port(unit="V"), output=Port(unit="rad"), blocks=(speed, position))


def test_rows_that_are_late_with_their_commands_are_jitter_and_its_size_is_found() -> None:
    found = diagnose(servo(), [late_servo(5, 0.003), late_servo(6, 0.003)])
    assert [e.name for e in found.effects] == ["timing.jitter"]
    assert found.effects[0].parameters["sd"].value == pytest.approx(0.003, rel=0.2)


def test_rows_in_time_are_no_jitter() -> None:
    found = diagnose(servo(), [late_servo(5, 0.0), late_servo(6, 0.0)])
    assert found.verdict in ("none", "parameters")
    assert not found.effects
