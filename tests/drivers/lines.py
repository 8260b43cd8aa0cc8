"""The lines of the fault campaign: a servo that remembers what it measured, behind each link, and means of harm."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import numpy as np

from autotune.config.procedure import LimitSettings
from autotune.config.rig import ModbusTcpSettings
from autotune.experiment.rig import Rig
from drivers import open_rig
from sim.modbus_rig import ModbusRig, RtuTransport, TcpTransport
from sim.register_device import OutputChange, RegisterDevice
from sim.serial_line import SerialLine
from sim.serial_rig import SerialRig, device_on_line
from sim.servo import Servo, ServoSettings
from tests.drivers.bench import (
    U_RANGE,
    U_SAFE,
    register_device,
    rtu_settings,
    serial_settings,
    tcp_settings,
)
from tests.drivers.tcp_relay import TcpRelay

TIMEOUT_S = 0.06
LIMITS = LimitSettings(u_min=-1.0, u_max=1.0, u_safe=U_SAFE, y_min=-3.0, y_max=3.0, swing=2.0, time_s=60.0)

Fate = Sequence[tuple[float, bytes]]
Harm = Callable[[bytes, str], Fate]

#: of the microcontroller's converter: fine, so that a measurement is known again in the recording
Y_SPAN, Y_FULL = (-2.0, 2.0), 65535


def by_float(y: float) -> float:
    """Return a measurement as registers show it: a float of 32 bits."""
    return float(np.float32(y))


def by_count(y: float) -> float:
    """Return a measurement as the microcontroller shows it: in counts of its converter."""
    return float(round((by_float(y) - Y_SPAN[0]) / ((Y_SPAN[1] - Y_SPAN[0]) / Y_FULL)))


class LoggedServo(Servo):
    """A servo that remembers when it measured what, as its line shows it."""

    def __init__(self, seed: int, shown: Callable[[float], float] = by_float) -> None:
        super().__init__(ServoSettings(load=0.05, noise=0.002, resolution=0.0), seed=seed)
        self.shown = shown
        self.measured: dict[float, list[float]] = {}

    def measure(self) -> float:
        y = super().measure()
        self.measured.setdefault(self.shown(y), []).append(self.time_s)
        return y


class Device(Protocol):
    """What the rig's own side says of the actuator: what moved it, and what moves it now."""

    @property
    def history(self) -> Sequence[OutputChange]: ...

    @property
    def output(self) -> float: ...


class Measured(Protocol):
    """What the rig's own side measured, as its line shows it, and when."""

    @property
    def shown(self) -> Callable[[float], float]: ...

    @property
    def measured(self) -> Mapping[float, Sequence[float]]: ...


@dataclass(kw_only=True)
class Line:
    """A rig on a line, the device behind it, and the means to harm both.

    ``settle`` waits until nobody moves the actuator any more; ``settings`` are the rig's, for a process of its own;
    ``relay`` is the level of y at which a session switches,
    and its commands above and below that.
    """

    rig: Rig
    device: Device
    plant: Measured
    random: random.Random
    settle: Callable[[], object]
    settings: ModbusTcpSettings | None = None
    limits: LimitSettings = LIMITS
    relay: tuple[float, float, float] = (0.0, -0.4, 0.4)
    restart: Callable[[], None] = lambda: None
    set_harm: Callable[[Harm], None] = lambda harm: None
    reset: Callable[[], None] = lambda: None
    refuse: Callable[[int, int], None] = lambda code, times: None
    unplug: Callable[[], None] = lambda: None
    jump: Callable[[float], None] = lambda seconds: None
    undo: ExitStack = field(default_factory=ExitStack)


def _whole(frame: bytes, direction: str) -> Fate:
    return ((0.0, frame),)


def _released(device: RegisterDevice) -> Callable[[], object]:
    """Return what waits until the device has been given back, or its dead-man has acted."""
    released = threading.Event()
    device.on_change = lambda change: released.set() if change.cause in ("dead-man", "given back") else None
    return lambda: released.wait(10.0)


def _reset_registers(device: RegisterDevice) -> None:
    """What a device's reset does: registers cleared, the actuator safe, nobody in command."""
    device._values |= {"heartbeat": 0.0, "u": 0.0, "enable": 0.0}
    device._release("given back")


@contextmanager
def tcp_line(seed: int) -> Iterator[Line]:
    """A rig on TCP with a relay in between."""
    plant = LoggedServo(seed)
    device = register_device(plant=plant)
    refusing: dict[str, Any] = {}

    def refuse(table: str, address: int, writes: bool) -> int | None:
        if refusing.get("left", 0) <= 0:
            return None
        refusing["left"] -= 1
        return int(refusing["code"])

    with (
        ModbusRig(device, TcpTransport(), refuse=refuse) as server,
        TcpRelay(server.port) as relay,
        ExitStack() as undo,
    ):
        settings = tcp_settings(relay.port, timeout_s=TIMEOUT_S)
        rig = open_rig(settings, u_range=(LIMITS.u_min, LIMITS.u_max), u_safe=U_SAFE)

        yield Line(
            rig=rig,
            settings=settings,
            device=device,
            plant=plant,
            random=random.Random(seed),
            settle=_released(device),
            set_harm=partial(setattr, relay, "tamper"),
            reset=relay.reset,
            restart=lambda: _reset_registers(device),
            refuse=lambda code, times: refusing.update(code=code, left=times),
            undo=undo,
        )
        rig.close()


@contextmanager
def rtu_line(seed: int) -> Iterator[Line]:
    """A rig on a serial line."""
    plant = LoggedServo(seed)
    device = register_device(plant=plant)
    with SerialLine(_whole) as line, ModbusRig(device, RtuTransport(device=line.rig_device, parity="N")):
        settings = rtu_settings(line.host_device, timeout_s=TIMEOUT_S, late_reply_s=0.2)
        rig = open_rig(settings, u_range=(LIMITS.u_min, LIMITS.u_max), u_safe=U_SAFE)

        yield Line(
            rig=rig,
            device=device,
            plant=plant,
            random=random.Random(seed),
            settle=_released(device),
            set_harm=partial(setattr, line, "tamper"),
        )
        rig.close()


@contextmanager
def serial_line(seed: int) -> Iterator[Line]:
    """A microcontroller on a serial line."""
    plant = LoggedServo(seed, by_count)
    device = device_on_line(plant, u_range=U_RANGE, u_safe=0.0)
    spans = {"y_span": Y_SPAN, "u_span": U_RANGE}
    with (
        SerialLine(_whole) as line,
        SerialRig(device, line.rig_device, y_full=Y_FULL, **spans) as served,
        ExitStack() as undo,
    ):
        settings = serial_settings(line.host_device, timeout_s=TIMEOUT_S, start_s=0.2, **spans)
        rig = open_rig(settings, u_range=(LIMITS.u_min, LIMITS.u_max), u_safe=U_SAFE)

        yield Line(
            rig=rig,
            device=device,
            plant=plant,
            random=random.Random(seed),
            settle=_released(device),
            set_harm=partial(setattr, line, "tamper"),
            reset=served.restart,
            unplug=line.close,
            jump=served.jump,
            undo=undo,
        )
        rig.close()
