"""Gains in the registers of a device, in the forms that makers have: written, read back, rounded, locked, refused."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from autotune.cli.served import spec_of
from autotune.config.procedure import DesignSettings
from autotune.config.registers import RegisterMap
from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.errors import DesignError, InputError
from autotune.experiment.rig import RoundsGains
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.models import TransferFunction
from autotune.pipeline.deployment import deploy
from autotune.pipeline.held_gains import round_to_rig
from autotune.points import FrequencyPoint
from sim.modbus_rig import ModbusRig, TcpTransport
from sim.register_device import RegisterDevice
from tests.drivers.bench import U_RANGE, rig_of, servo, tcp_settings

Y_AND_U: dict[str, Any] = {"y": {"table": "input", "address": 0}, "u": {"address": 0}}


def registers_of(form: str, *names: str, fixed: dict[str, float] | None = None, **spans: float) -> RegisterMap:
    """Return a map with a float for each setting."""
    settings = {name: {"address": 10 + 2 * i, "type": "float32"} for i, name in enumerate(names)}
    gains = {"form": form, "settings": settings, "fixed": fixed or {}, **spans}
    return RegisterMap.model_validate({**Y_AND_U, "gains": gains})


@contextmanager
def served(registers: RegisterMap, held: dict[str, float] | None = None) -> Iterator[tuple[RegisterDevice, Any]]:
    """Yield the device, which knows nothing of forms, and the rig in front of it."""
    specs = {name: spec_of(register) for name, register in registers.mapped().items()}
    code = None
    if registers.unlock is not None:
        specs["unlock"], code = spec_of(registers.unlock), float(registers.unlock.code)
    nothing = {name: 0.0 for name in specs if name.startswith("gains.")}
    device = RegisterDevice(
        servo(), specs, u_safe=0.0, u_range=U_RANGE, held=nothing | (held or {}), gains=(1.5, 2.0), unlock_code=code
    )
    with ModbusRig(device, TcpTransport()) as server:
        rig = rig_of(tcp_settings(server.port, registers))
        yield device, rig
        rig.close()


PI = PIDController(K=2.0, Ti_s=90.0)
PID = PIDController(K=2.0, Ti_s=90.0, Td_s=15.0, Tf_s=3.0)


@pytest.mark.parametrize(
    ("registers", "controller", "held"),
    [
        # 2 %/degC over 200 degC: 50 degC of 200 move the output fully; 90 s are a minute and a half
        (
            registers_of("proportional-band", "PB_percent", "reset_min", u_span=100.0, y_span=200.0),
            PI,
            {"PB_percent": 25.0, "reset_min": 1.5},
        ),
        (
            registers_of("rockwell-independent", "PGain", "IGain_per_min", u_span=100.0, y_span=200.0),
            PI,
            {"PGain": 4.0, "IGain_per_min": 4.0 / 1.5},
        ),
        (registers_of("parallel", "Kp", "Ki_per_s"), PI, {"Kp": 2.0, "Ki_per_s": 2.0 / 90.0}),
        (registers_of("parallel", "Kp", "Ki_per_s"), PIDController(K=2.0, Ti_s=math.inf), {"Kp": 2.0, "Ki_per_s": 0.0}),
        (
            registers_of("parallel", "Kp", "Ki_per_s", "Kd_s", "Tf_s"),
            PID,
            {"Kp": 2.0, "Ki_per_s": 2.0 / 90.0, "Kd_s": 30.0, "Tf_s": 3.0},
        ),
        # without an action of its own the sign is in the gains; with one, the maker's are positive
        (registers_of("parallel", "Kp", "Ki_per_s"), PIDController(K=-2.0, Ti_s=4.0), {"Kp": -2.0, "Ki_per_s": -0.5}),
        (
            registers_of("parallel", "Kp", "Ki_per_s", fixed={"reverse_acting": 0.0}),
            PIDController(K=-2.0, Ti_s=4.0),
            {"Kp": 2.0, "Ki_per_s": 0.5},
        ),
        (
            registers_of("rockwell-dependent", "PGain", "IGain_min", "DGain_min", "pv_filter_s", "reverse_acting"),
            PIDController(K=-2.0, Ti_s=90.0, Td_s=15.0, Tf_s=3.0),
            {"PGain": 2.0, "IGain_min": 1.5, "DGain_min": 0.25, "pv_filter_s": 3.0, "reverse_acting": 0.0},
        ),
        (registers_of("isa", "K", "Ti_s"), PIDController(K=2.0, Ti_s=math.inf), {"K": 2.0, "Ti_s": 0.0}),
    ],
    ids=lambda value: value.held_gains.form if isinstance(value, RegisterMap) else "",
)
def test_gains_are_held_as_the_maker_has_them(
    registers: RegisterMap, controller: PIDController, held: dict[str, float]
) -> None:
    with served(registers) as (device, rig):
        rig.write_gains(controller)
        assert {name: device.value[f"gains.{name}"] for name in held} == pytest.approx(held, rel=1e-6)
        found = rig.read_gains()
        expected = rig.holdable(controller)
        assert found == expected
        for name in ("K", "Ti_s", "Td_s", "Tf_s"):
            assert getattr(found, name) == pytest.approx(getattr(controller, name), rel=1e-5)


def test_a_pid_in_plain_registers() -> None:
    plain = {"K": 10, "Ti": 12, "Td": 14, "Tf": 16}
    registers = RegisterMap.model_validate(
        Y_AND_U | {name: {"address": address, "type": "float64" if name == "K" else "float32"} for name, address in
                   {**plain, "K": 30}.items()}
    )  # fmt: skip
    with served(registers) as (device, rig):
        rig.write_gains(PID)
        assert [device.value[name] for name in plain] == [2.0, 90.0, 15.0, 3.0]
        assert rig.read_gains() == PID


@pytest.mark.parametrize(
    ("registers", "controller", "reason"),
    [
        (registers_of("parallel", "Kp", "Ki_per_s"), PID, "map the register of Kd_s"),
        (registers_of("isa", "K"), PI, "needs Ti_s = 90"),
        (registers_of("isa", "K", "Ti_s", fixed={"reverse_acting": 1.0}), PIDController(K=-1.0, Ti_s=1.0), "action"),
        (registers_of("isa", "K", "Ti_s"), PIDController(K=1e39, Ti_s=1.0), "does not fit"),
    ],
)
def test_what_the_device_has_no_place_for_is_refused_before_anything_is_written(
    registers: RegisterMap, controller: PIDController, reason: str
) -> None:
    with served(registers) as (device, rig):
        before = dict(device.value)
        with pytest.raises((InputError, DesignError), match=reason):
            rig.write_gains(controller)
        assert device.value == before


@pytest.mark.parametrize(
    ("gains", "reason"),
    [
        ({"form": "tuned", "settings": {}}, "none of isa"),
        ({"form": "isa", "settings": {"Kp": {"address": 9}}}, "no setting of the form isa"),
        ({"form": "isa", "settings": {"Ti_s": {"address": 9}}}, "K of the form isa needs a register"),
        ({"form": "isa", "settings": {"K": {"address": 9}}, "fixed": {"K": 1.0}}, "both in a register and fixed"),
        ({"form": "isa", "settings": {"K": {"address": 9, "bit": 1}}}, "K is a number"),
        ({"form": "isa", "settings": {"K": {"address": 0}}}, "overlap"),
        ({"form": "isa", "settings": {"K": {"table": "input", "address": 9}}}, "cannot lie in table"),
    ],
)
def test_a_map_of_gains_that_cannot_be_is_refused(gains: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        RegisterMap.model_validate({**Y_AND_U, "gains": gains})


def test_a_locked_device_is_unlocked_for_the_gains_and_locked_again() -> None:
    unlock = {"unlock": {"address": 40, "type": "uint16", "code": 4711, "lock": 0}}
    given = RegisterMap.model_validate(registers_of("isa", "K", "Ti_s").model_dump(exclude_none=True) | unlock)
    with served(given) as (device, rig):
        rig.write_gains(PI)
        assert rig.read_gains() == PI
        assert device.value["unlock"] == 0.0
    without = registers_of("isa", "K", "Ti_s")
    with served(given) as (device, rig):
        server_port = rig._link._settings.port
        stranger = rig_of(tcp_settings(server_port, without))
        with pytest.raises(Exception, match="refuses that value"):
            stranger.write_gains(PI)
        assert device.value["gains.K"] == 0.0
        stranger.close()


def coarse(K_scale: float, Ti_scale: float = 0.01) -> RegisterMap:
    return RegisterMap.model_validate(
        Y_AND_U | {"K": {"address": 10, "scale": K_scale}, "Ti": {"address": 11, "type": "uint16", "scale": Ti_scale}}
    )


def test_a_gain_that_its_register_would_round_to_nothing_is_refused_with_the_scale_that_would_do(
    tmp_path: Path,
) -> None:
    wanted = PIDController(K=-0.024, Ti_s=3.6)
    with served(coarse(0.1)) as (device, rig):
        assert rig.holdable(wanted).K == 0.0
        with pytest.raises(InputError, match=r"K would be -?0.*rig.registers.K holds -?0 for -0.024: scale = 0.0002"):
            deploy(rig, wanted, tmp_path / "journal.jsonl", agree=lambda old, new: None, try_out=None)
        assert (device.value["K"], device.value["Ti"]) == (1.5, 2.0)
    with served(coarse(0.0002)) as (device, rig):  # the scale that it asked for
        done = deploy(rig, wanted, tmp_path / "second.jsonl", agree=lambda old, new: None, try_out=None)
        assert done.new == rig.holdable(wanted)
        assert device.value["K"] == pytest.approx(-0.024, abs=0.0001)


PLANT = TransferFunction(num=(1.0,), den=(2.0, 1.0), delay_s=0.5)


@pytest.fixture(scope="module")
def fit() -> PlantFit:
    """Return the plant as five of its points know it."""
    omega = np.array([0.8, 1.2, 1.6, 2.2, 2.8])
    small = ((1e-8, 0.0), (0.0, 1e-8))
    return fit_plant(
        [
            FrequencyPoint(omega_rad_s=float(w), response=complex(H), covariance=small)
            for w, H in zip(omega, PLANT.response(omega), strict=True)
        ]
    )


def test_a_resolution_that_takes_a_margin_is_refused_and_one_that_does_not_is_the_controller(fit: PlantFit) -> None:
    asked = DesignSettings(noise_gain=10.0)
    exact = PIDController(K=2.5, Ti_s=2.0)
    before = margins(fit.plant, exact)
    assert before.modulus == pytest.approx(0.5, abs=0.05)  # about what is asked for: nothing to give away
    with served(coarse(1.0)) as (_, rig):  # K = 2 keeps the margins, and loses a fifth of the gain
        held = round_to_rig(rig, exact, asked, fit=fit)
        assert held == PIDController(K=2.0, Ti_s=2.0)
        up = PIDController(K=2.6, Ti_s=2.0)
        with pytest.raises(InputError, match=r"modulus margin of 0\.470.*rig.registers.K .* scale = 0.02"):
            round_to_rig(rig, up, asked, fit=fit)
    with (
        served(coarse(1.0, Ti_scale=1.0)) as (_, rig),
        pytest.raises(InputError, match=r"Ti_s would be inf.*rig.registers.Ti holds 0 for 0.4: scale = 0.002"),
    ):
        round_to_rig(rig, PIDController(K=2.0, Ti_s=0.4), asked)


@given(K=st.floats(-30.0, 30.0), Ti_s=st.floats(0.01, 600.0), scale=st.sampled_from([1e-3, 0.02, 0.1, 1.0]))
@example(K=1e-11, Ti_s=1.0, scale=1e-3)  # a hundredth of it is just less than a power of ten
def test_what_a_register_can_hold_is_held_unchanged(K: float, Ti_s: float, scale: float) -> None:
    rig = rig_of(tcp_settings(1, coarse(scale)))  # nothing is asked of the line
    assert isinstance(rig, RoundsGains)
    held = rig.holdable(PIDController(K=K, Ti_s=Ti_s))
    assert rig.holdable(held) == held
    assert abs(held.K - K) <= 0.5001 * scale
    if rig.coarse(PIDController(K=K, Ti_s=Ti_s)) == ():
        assert pytest.approx(K, rel=0.0051) == held.K
        assert held.Ti_s == pytest.approx(Ti_s, rel=0.0051)


def test_a_gain_that_is_no_number_is_refused_before_any_register_is_asked() -> None:
    with pytest.raises(InputError, match="finite"):
        PIDController(K=math.nan, Ti_s=1.0)
