"""The kinds of rigs: one table, with a line for each ``kind`` of ``[rig]`` and the file that reaches it.

A driver's file has ``open_kind(settings, session)``, which returns the rig, not yet opened. It may have
``reached_by(settings)``, which says what has to be there before anything can be sent (absent: nothing, the rig is in
this process), and ``probe_kind(settings, expected)``, which reads everything once and writes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, get_args

from autotune.config.rig import (
    RIG_SETTINGS,
    ModbusRtuSettings,
    ModbusTcpSettings,
    ModbusTlsSettings,
    ReplaySettings,
    SerialSettings,
    SimulatedRigSettings,
)
from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.experiment.rig import Rig
from autotune.schema import Section


@dataclass(frozen=True, kw_only=True)
class Session:
    """What a rig is opened for.

    Attributes
    ----------
    u_range : (float, float)
        Lowest and highest command of the experiment [u unit].
    u_safe : float
        Command that the rig is left with [u unit].
    controller : PIDController or None
        Gains that a simulated rig's own controller is delivered with; a real one holds its own.
    """

    u_range: tuple[float, float]
    u_safe: float
    controller: PIDController | None = None


@dataclass(frozen=True, kw_only=True)
class Reach:
    """What has to be there for a rig to be reached; nothing of it where the rig is in this process.

    Attributes
    ----------
    files : tuple of str
        Files that are read: certificates, a recording.
    device : str
        Serial device.
    address : (str, int) or None
        Host and TCP port.
    timeout_s : float
        Longest wait for an answer [s].
    """

    files: tuple[str, ...] = ()
    device: str = ""
    address: tuple[str, int] | None = None
    timeout_s: float = 1.0


@dataclass(frozen=True)
class Kind:
    """A line of the table.

    Attributes
    ----------
    settings : type
        The table ``[rig]`` of this kind.
    driver : str
        Module that reaches it; imported when it is needed, so that a simulated run does not pay for the Modbus library.
    has_registers : bool
        Whether its signals are in a register map.
    """

    settings: type[Section]
    driver: str
    has_registers: bool = False

    @property
    def name(self) -> str:
        """What ``kind`` says in ``[rig]``."""
        return str(get_args(self.settings.model_fields["kind"].annotation)[0])

    def open(self, settings: Section, session: Session) -> Rig:
        """Return the rig, not yet opened."""
        rig: Rig = import_module(self.driver).open_kind(settings, session)
        return rig

    def reached_by(self, settings: Section) -> Reach:
        """Return what has to be there."""
        say = getattr(import_module(self.driver), "reached_by", None)
        return say(settings) if say is not None else Reach()

    def probe(self, settings: Section, expected: Mapping[str, tuple[float, float]]) -> Any:
        """Read everything once; nothing is written.

        Returns
        -------
        tuple of ProbedRegister, or ProbedDevice
            See :mod:`drivers.probe`.

        Raises
        ------
        InputError
            The driver has no means to.
        LinkError
            Nobody answers.
        """
        look = getattr(import_module(self.driver), "probe_kind", None)
        if look is None:
            raise InputError(
                f'kind = "{getattr(settings, "kind", "")}" has no registers and nothing else to read without a command',
                where="rig",
                remedy="autotune doctor CONFIG.toml says whether it can be reached",
            )
        return look(settings, expected)


KINDS = (
    Kind(SimulatedRigSettings, "drivers.simulated"),
    Kind(ReplaySettings, "drivers.replay"),
    Kind(ModbusTcpSettings, "drivers.modbus_rig", has_registers=True),
    Kind(ModbusTlsSettings, "drivers.modbus_rig", has_registers=True),
    Kind(ModbusRtuSettings, "drivers.modbus_rig", has_registers=True),
    Kind(SerialSettings, "drivers.device_rig"),
)

_BY_SETTINGS = {kind.settings: kind for kind in KINDS}
if missing := [settings.__name__ for settings in RIG_SETTINGS if settings not in _BY_SETTINGS]:
    raise TypeError(f"no line in drivers/kinds.py for {', '.join(missing)}")


def kind_of(settings: Section) -> Kind:
    """Return the line of the table for the settings of a rig."""
    return _BY_SETTINGS[type(settings)]
