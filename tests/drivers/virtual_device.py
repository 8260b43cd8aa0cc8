"""A device with registers on a virtual clock: the driver as it is, without a wire, in far less than the rig's time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from autotune.cli.served import spec_of
from autotune.config.registers import RegisterMap
from autotune.errors import LinkError
from drivers.gain_rig import GainRegisterRig
from drivers.register_link import Answer
from drivers.registers import Block
from sim.plant import Plant
from sim.register_device import RegisterDevice

REQUEST_S = 0.001


class VirtualClock:
    """Time that moves only when somebody waits; the device lives on meanwhile."""

    def __init__(self, device: RegisterDevice) -> None:
        self.t_s = 0.0
        self._device = device

    def now(self) -> float:
        return self.t_s

    def sleep_until(self, t_s: float) -> None:
        self.t_s = max(self.t_s, t_s)
        self._device.live(self.t_s)


class DirectLink:
    """Requests that the device answers within a millisecond of its own time."""

    where = "virtual device"

    def __init__(self, device: RegisterDevice, clock: VirtualClock) -> None:
        self._device, self._clock = device, clock
        self.writes: list[tuple[str, int, list[int]]] = []
        #: asked before every request; raises what the line does
        self.before: Callable[[], None] = lambda: None

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def distrust(self) -> None: ...

    def read(self, block: Block) -> Answer:
        self._pass()
        words = self._device.read(block.table, block.address, block.count, self._clock.t_s)  # type: ignore[arg-type]
        return Answer(words, False, REQUEST_S)

    def write(self, table: str, address: int, words: Sequence[int]) -> bool:
        self._pass()
        self.writes.append((table, address, list(words)))
        self._device.write(table, address, words, self._clock.t_s)  # type: ignore[arg-type]
        return False

    def _pass(self) -> None:
        self._clock.sleep_until(self._clock.t_s + REQUEST_S)
        self.before()


def virtual_rig(
    plant: Plant,
    *,
    registers: Mapping[str, Any],
    on_device: Mapping[str, Any] | None = None,
    u_range: tuple[float, float] = (0.0, 10.0),
    u_safe: float = 0.0,
    scan_s: float = 0.01,
    **device: Any,
) -> tuple[GainRegisterRig, RegisterDevice]:
    """Return a rig and the device behind it.

    ``registers`` is what the host believes; ``on_device`` replaces the forms in which the device has some of them, and
    ``device`` is passed on to it.
    """
    believed = RegisterMap.model_validate(dict(registers))
    true = RegisterMap.model_validate(
        {name: {**given, **(on_device or {}).get(name, {})} for name, given in registers.items()}
    )
    specs = {name: spec_of(register) for name, register in true.mapped().items()}
    held = RegisterDevice(plant, specs, u_safe=u_safe, u_range=u_range, scan_s=scan_s, **device)
    clock = VirtualClock(held)
    rig = GainRegisterRig(
        DirectLink(held, clock), believed, u_range=u_range, u_safe=u_safe, scan_time_s=scan_s, clock=clock
    )
    return rig, held


def failing(times: int, moment: int = 0) -> Callable[[], None]:
    """Return a line that fails so many requests from a moment on."""
    count = itertools.count()

    def before() -> None:
        if moment <= next(count) < moment + times:
            raise LinkError("the device is busy", where=DirectLink.where)

    return before


NEVER = math.inf
