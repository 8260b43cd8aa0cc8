"""Rigs behind an OPC UA server: how they are opened, what has to be there, what can be read first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from autotune.config.rig import OpcUaSettings
from autotune.config.signal_map import SAMPLE
from autotune.experiment.rig import Rig
from drivers.gain_rig import TypedGainRig, open_registers
from drivers.kinds import Reach, Session, not_installed
from drivers.operated_relay import OperatedRelayRig, tell_relay
from drivers.pace import tell_pace
from drivers.probe import ProbedDevice, ProbedSignal
from drivers.registers import blocks, codecs

if TYPE_CHECKING:
    from drivers.opcua import OpcUaLink

#: port where an endpoint names none
_PORT = 4840


def _link(settings: OpcUaSettings, *, exclusive: bool = True) -> OpcUaLink:
    try:
        from drivers.opcua import OpcUaLink
    except ModuleNotFoundError as error:
        raise not_installed(error, "opcua") from None
    return OpcUaLink(settings, exclusive=exclusive)


def open_kind(settings: OpcUaSettings, session: Session) -> Rig:
    """Return the rig, with its own controller's gains where they are mapped, and its own relay where it has one.

    Parameters
    ----------
    settings : OpcUaSettings
        The table ``[rig]``.
    session : Session
        What it is opened for.
    """
    link = _link(settings)
    if settings.relay is None:
        return open_registers(link, settings, session, TypedGainRig)
    return open_registers(link, settings, session, OperatedRelayRig, arrays=link, relay=settings.relay)


def reach_of(settings: OpcUaSettings) -> Reach:
    """Return the server's address, and the certificates."""
    parts = urlsplit(settings.endpoint)
    named = (settings.cert_file, settings.key_file, settings.server_cert_file, settings.password_file)
    return Reach(
        files=tuple(file for file in named if file is not None),
        address=(parts.hostname or "", parts.port or _PORT),
        timeout_s=settings.timeout_s,
    )


def probe_kind(settings: OpcUaSettings, expected: Mapping[str, tuple[float, float]]) -> ProbedDevice:
    """Return every mapped node, read once; types and rights are looked at on the way.

    Parameters
    ----------
    settings : OpcUaSettings
        The table ``[rig]``.
    expected : mapping of str to (float, float)
        Range within which a signal's engineering value is plausible.
    """
    link = _link(settings, exclusive=False)
    link.connect()
    found, mapped = [], codecs(settings.registers.mapped())
    try:
        pace = tell_pace(link, (codec for name, codec in mapped.items() if name in SAMPLE))
        if settings.relay is not None:
            pace += f"; {tell_relay(link, settings.relay)}"
        for codec in mapped.values():
            value = codec.decode(link.read(blocks([codec])[0]).words) if codec.name != "device_time" else None
            if value is None:
                continue
            low, high = expected.get(codec.name, (value, value))
            said = () if low <= value <= high else (f"{value:.6g}, expected {low:g}..{high:g}: check scale and offset",)
            node = getattr(settings.nodes, codec.name)
            found.append(ProbedSignal(name=codec.name, raw=node.node, value=value, warnings=said))
    finally:
        link.disconnect()
    return ProbedDevice(description=f"OPC UA server {settings.endpoint}; {pace}", signals=tuple(found))
