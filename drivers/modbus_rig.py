"""Rigs on Modbus, whatever the transport: how they are opened, what has to be there, what can be read first."""

from __future__ import annotations

from typing import assert_never

from autotune.config.rig import AnyModbusSettings, ModbusRtuSettings, ModbusTcpSettings, ModbusTlsSettings
from autotune.experiment.rig import Rig
from drivers.gain_rig import GainRegisterRig, open_registers
from drivers.kinds import Reach, Session
from drivers.modbus import ModbusLink
from drivers.probe import probe


def open_kind(settings: AnyModbusSettings, session: Session) -> Rig:
    """Return the rig, with its own controller's gains where they are mapped.

    Parameters
    ----------
    settings : AnyModbusSettings
        The table ``[rig]``.
    session : Session
        What it is opened for.
    """
    return open_registers(ModbusLink(settings), settings, session, GainRegisterRig, permissives=settings.permissives)


def reach_of(settings: AnyModbusSettings) -> Reach:
    """Return address or serial device, and the certificates."""
    match settings:
        case ModbusTcpSettings():
            return Reach(address=(settings.host, settings.port), timeout_s=settings.timeout_s)
        case ModbusTlsSettings():
            files = (settings.ca_file, settings.cert_file, settings.key_file)
            return Reach(files=files, address=(settings.host, settings.port), timeout_s=settings.timeout_s)
        case ModbusRtuSettings():
            return Reach(device=settings.device)
    assert_never(settings)


probe_kind = probe
