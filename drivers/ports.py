"""The serial ports of this computer, and what answers on them: a microcontroller of ours, or a Modbus device."""

from __future__ import annotations

from dataclasses import dataclass

from serial.tools import list_ports

from autotune.config.registers import RegisterMap, RegisterSettings
from autotune.config.rig import ModbusRtuSettings, SerialSettings
from autotune.errors import LinkError
from drivers.clock import MonotonicClock
from drivers.modbus import DeviceRefused, ModbusLink
from drivers.registers import Codec, blocks
from drivers.serial_line import SerialLink

#: Line settings that devices are delivered with, the usual ones first.
_USUAL = ((19200, "E"), (9600, "E"), (9600, "N"), (19200, "N"), (115200, "N"))


@dataclass(frozen=True, kw_only=True)
class SerialPort:
    """A serial port: device name, description, hardware id."""

    device: str
    description: str
    hardware: str


def serial_ports() -> tuple[SerialPort, ...]:
    """Return the serial ports that the operating system lists, in the order of their names."""
    return tuple(
        SerialPort(device=port.device, description=port.description or "", hardware=port.hwid or "")
        for port in sorted(list_ports.comports())
    )


def answers_on(device: str, unit_id: int = 1, *, start_s: float = 2.5) -> str:
    """Return what answers on a port: HELLO to a microcontroller first, then a Modbus RTU read at the usual settings.

    Parameters
    ----------
    device : str
        Serial device.
    unit_id : int
        Unit id to ask for, 1 to 247.
    start_s : float
        Time that a board gets to start after its line was opened [s].

    Notes
    -----
    HELLO changes nothing, one holding register is read and nothing is written, but bytes are sent: do not ask where
    something that is neither could take them for a command. Opening a line restarts a board whose reset hangs on DTR.
    """
    found = _microcontroller(device, start_s)
    if found:
        return found
    for baud, parity in _USUAL:
        found = _answer(device, unit_id, baud, parity)
        if found:
            return found
    return "nothing"


def _microcontroller(device: str, start_s: float) -> str:
    settings = SerialSettings.model_validate(
        {"kind": "serial", "device": device, "start_s": start_s, "y_span": (0.0, 1.0), "u_span": (0.0, 1.0)}
    )
    link = SerialLink(settings, MonotonicClock())
    try:
        version, *_ = link.connect().values
    except LinkError as error:
        return f"a microcontroller that {error.what}" if "version" in error.what else ""
    finally:
        link.disconnect()
    return f"microcontroller, firmware {version:g}, at {settings.baud} bit/s"


def _answer(device: str, unit_id: int, baud: int, parity: str) -> str:
    register = RegisterSettings(address=0)
    settings = ModbusRtuSettings.model_validate(
        {
            "kind": "modbus_rtu",
            "device": device,
            "baud": baud,
            "parity": parity,
            "unit_id": unit_id,
            "retries": 0,
            "late_reply_s": 0.3,
            "registers": RegisterMap(y=register, u=RegisterSettings(address=1)),
        }
    )
    link = ModbusLink(settings)
    (block,) = blocks([Codec(name="first register", register=register)])
    line = f"{baud} bit/s, parity {parity}"
    try:
        link.connect()
        link.read(block)
    except DeviceRefused:
        pass  # an exception is an answer too
    except LinkError:
        return ""
    finally:
        link.disconnect()
    return f"Modbus RTU unit {unit_id} at {line}"
