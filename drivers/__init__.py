"""How a rig is reached: in process, over Modbus, over a serial line, or replayed from a recording."""

from __future__ import annotations

from autotune.config.rig import (
    ModbusRtuSettings,
    ModbusTcpSettings,
    ModbusTlsSettings,
    ReplaySettings,
    RigSettings,
    SerialSettings,
    SimulatedRigSettings,
)
from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.experiment.rig import Rig

__all__ = ["open_rig", "twin_of"]


def open_rig(
    settings: RigSettings,
    *,
    u_range: tuple[float, float],
    u_safe: float,
    controller: PIDController | None = None,
) -> Rig:
    """Return the rig that ``[rig]`` describes, not yet opened: nothing has been sent to it.

    Parameters
    ----------
    settings : RigSettings
        The table ``[rig]`` of the configuration.
    u_range : (float, float)
        Lowest and highest command of the experiment [u unit].
    u_safe : float
        Command that the rig is left with [u unit].
    controller : PIDController, optional
        Gains that a simulated rig's own controller is delivered with; a real one holds its own.

    Raises
    ------
    InputError
        A register cannot hold the commands, a certificate or a recording cannot be read.
    """
    # imported here so that a simulated run does not pay for the Modbus library, nor a real one for the plants
    match settings:
        case SimulatedRigSettings():
            from drivers.simulated import open_simulated

            return open_simulated(settings, u_safe=u_safe, controller=controller)
        case ReplaySettings():
            from drivers.replay import open_replay

            return open_replay(settings)
        case SerialSettings():
            from drivers.device_rig import DeviceLawRig
            from drivers.serial_rig import SerialLineRig

            on_line = DeviceLawRig if settings.relay == "device" else SerialLineRig
            return on_line(settings, u_range=u_range, u_safe=u_safe)
        case ModbusTcpSettings() | ModbusTlsSettings() | ModbusRtuSettings():
            from drivers.gain_rig import GainRegisterRig
            from drivers.modbus import ModbusLink
            from drivers.register_rig import RegisterRig

            kind = RegisterRig if settings.registers.held_gains is None else GainRegisterRig
            return kind(
                ModbusLink(settings),
                settings.registers,
                u_range=u_range,
                u_safe=u_safe,
                feed_s=settings.feed_s,
                scan_time_s=settings.scan_time_s,
                permissives=settings.permissives,
            )


def twin_of(settings: RigSettings) -> SimulatedRigSettings:
    """Return the simulated twin of a rig, for a dry run.

    Raises
    ------
    InputError
        The configuration names none.
    """
    match settings:
        case SimulatedRigSettings():
            return settings
        case (
            ModbusTcpSettings(twin=twin)
            | ModbusTlsSettings(twin=twin)
            | ModbusRtuSettings(twin=twin)
            | SerialSettings(twin=twin)
        ) if twin:
            return SimulatedRigSettings(
                kind="simulated", plant=twin.plant, seed=twin.seed, noise=twin.noise, start=twin.start
            )
    raise InputError(
        "the rig has no simulated twin", where="rig.twin", remedy='name its plant: [rig.twin] plant = "ball"'
    )
