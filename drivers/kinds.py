"""The kinds of rigs: one table, with a line for each ``kind`` of ``[rig]`` and the file that reaches it.

A driver's file has ``open_kind(settings, session)``, which returns the rig, not yet opened. It may have
``reach_of(settings)``, which says what has to be there before anything can be sent (absent: nothing, the rig is in
this process), and ``probe_kind(settings, expected)``, which reads everything once and writes nothing.
"""

from __future__ import annotations

import ast
import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from autotune.config.rig import (
    RIG_SETTINGS,
    ModbusRtuSettings,
    ModbusTcpSettings,
    ModbusTlsSettings,
    OpcUaSettings,
    ReplaySettings,
    SerialSettings,
    SimulatedRigSettings,
    rig_kind_of,
)
from autotune.config.s7 import S7Settings
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
    speed : float
        Seconds of a simulated rig in a second of whoever watches; infinite: as fast as the processor allows.
    """

    u_range: tuple[float, float]
    u_safe: float
    controller: PIDController | None = None
    speed: float = math.inf


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
        return rig_kind_of(self.settings)

    def open(self, settings: Section, session: Session) -> Rig:
        """Return the rig, not yet opened.

        Parameters
        ----------
        settings : Section
            The table ``[rig]``.
        session : Session
            What it is opened for.

        Raises
        ------
        InputError
            A file that is needed to reach it is not there.
        """
        self._require_files(settings)
        rig: Rig = import_module(self.driver).open_kind(settings, session)
        return rig

    def reach_of(self, settings: Section) -> Reach:
        """Return what has to be there."""
        say = getattr(import_module(self.driver), "reach_of", None)
        return say(settings) if say is not None else Reach()

    def probe(self, settings: Section, expected: Mapping[str, tuple[float, float]]) -> Any:
        """Read everything once; nothing is written.

        Parameters
        ----------
        settings : Section
            The table ``[rig]``.
        expected : mapping of str to (float, float)
            Range within which a signal's engineering value is plausible.

        Returns
        -------
        tuple of ProbedRegister, or ProbedDevice
            See :mod:`drivers.probe`.

        Raises
        ------
        InputError
            The driver has no means to, or lacks a file for it.
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
        self._require_files(settings)
        return look(settings, expected)

    def _require_files(self, settings: Section) -> None:
        """Refuse before anything is made for a session that cannot begin."""
        for file in self.reach_of(settings).files:
            if not Path(file).is_file():
                raise InputError(
                    "no such file",
                    where=file,
                    remedy="give its path as seen from this folder; certificates: docs/modbus_tls.md, docs/opcua.md",
                )


KINDS = (
    Kind(SimulatedRigSettings, "drivers.simulated"),
    Kind(ReplaySettings, "drivers.replay"),
    Kind(ModbusTcpSettings, "drivers.modbus_rig", has_registers=True),
    Kind(ModbusTlsSettings, "drivers.modbus_rig", has_registers=True),
    Kind(ModbusRtuSettings, "drivers.modbus_rig", has_registers=True),
    Kind(OpcUaSettings, "drivers.opcua_rig"),
    Kind(S7Settings, "drivers.s7_rig"),
    Kind(SerialSettings, "drivers.device_rig"),
)


def require_complete(kinds: Sequence[Kind], known: Sequence[type[Section]] = RIG_SETTINGS) -> None:
    """Refuse a table in which something is missing; no driver is imported for that.

    Parameters
    ----------
    kinds : sequence of Kind
        The table.
    known : sequence of types
        Settings that a configuration may have.

    Raises
    ------
    InputError
        The first thing that is missing, and how to add it.
    """
    for settings in known:
        if settings not in [kind.settings for kind in kinds]:
            _refuse(f"no line for {settings.__name__}", f'add Kind({settings.__name__}, "drivers.FILE")')
    for kind in kinds:
        name = kind.settings.__name__
        if kind.settings not in known:
            _refuse(f"{name} is no [rig] that a configuration may have", "add it to RigSettings in config/rig.py")
        found = find_spec(kind.driver)
        if found is None or found.origin is None:
            _refuse(f"{name} is reached by {kind.driver}, which does not exist", "correct its name, or write it")
    for driver in dict.fromkeys(kind.driver for kind in kinds):
        _require_rig(driver)


def _require_rig(driver: str) -> None:
    """Refuse a driver's file that opens no rig, as it is written; a class that inherits is not looked into."""
    spec = find_spec(driver)
    body = ast.parse(Path(str(spec and spec.origin)).read_text(encoding="utf-8")).body
    opener = next((node for node in body if isinstance(node, ast.FunctionDef) and node.name == "open_kind"), None)
    if opener is None:
        _refuse(f"{driver} has no open_kind", "add def open_kind(settings, session), which returns the rig")
        return
    if len(opener.args.args) != 2:
        _refuse(f"open_kind of {driver} takes {ast.unparse(opener.args)}", "write def open_kind(settings, session)")
    for made in (node for node in body if isinstance(node, ast.ClassDef)):
        if opener.returns is None or made.name != ast.unparse(opener.returns) or made.bases:
            continue
        has = {node.name for node in made.body if isinstance(node, ast.FunctionDef)}
        has |= {node.attr for node in ast.walk(made) if isinstance(node, ast.Attribute) and _is_set(node)}
        lacks = [name for name in _PARTS if name not in has]
        if lacks:
            _refuse(f"{made.name} of {driver} has no {lacks[0]}", f"a rig has {', '.join(_PARTS)}")


#: What every rig has.
_PARTS = tuple(
    name
    for name, part in vars(Rig).items()
    if not name.startswith("_") and (inspect.isfunction(part) or isinstance(part, property))
)


def _is_set(node: ast.Attribute) -> bool:
    return isinstance(node.ctx, ast.Store) and isinstance(node.value, ast.Name) and node.value.id == "self"


def _refuse(what: str, remedy: str) -> None:
    raise InputError(what, where="drivers/kinds.py", remedy=remedy)


require_complete(KINDS)
_BY_SETTINGS = {kind.settings: kind for kind in KINDS}


def not_installed(error: ModuleNotFoundError, extra: str) -> InputError:
    """Return what is said where a kind's library is absent: the extra of its name brings it.

    Parameters
    ----------
    error : ModuleNotFoundError
        What the import raised.
    extra : str
        Name of the kind, and of the extra.
    """
    remedy = f'pip install "relay-autotune[{extra}]"'
    return InputError(f"{error.name} is not installed", where=f'kind = "{extra}"', remedy=remedy)


def kind_of(settings: Section) -> Kind:
    """Return the line of the table for the settings of a rig."""
    return _BY_SETTINGS[type(settings)]
