"""How a rig is reached: in process, over Modbus, over a serial line, or replayed from a recording."""

from __future__ import annotations

import math

from autotune.config.rig import RigSettings, SimulatedRigSettings
from autotune.config.twin import PlantSettings, TwinSettings
from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.experiment.rig import Rig
from drivers.kinds import Session, kind_of

__all__ = ["open_rig", "twin_of"]


def open_rig(
    settings: RigSettings,
    *,
    u_range: tuple[float, float],
    u_safe: float,
    controller: PIDController | None = None,
    speed: float | None = None,
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
    speed : float, optional
        Seconds of a simulated rig in a second of whoever watches; as fast as the processor allows where not given.

    Raises
    ------
    InputError
        A speed for a rig that has its own time, a register that cannot hold the commands, a certificate or a recording
        that cannot be read.
    """
    if speed is not None and not isinstance(settings, SimulatedRigSettings):
        remedy = "give it for a simulated rig, or with --dry-run"
        raise InputError("a rig has its own time", where="--speed", remedy=remedy)
    fast = math.inf if speed is None else speed
    session = Session(u_range=u_range, u_safe=u_safe, controller=controller, speed=fast)
    return kind_of(settings).open(settings, session)


def twin_of(settings: RigSettings) -> SimulatedRigSettings:
    """Return the simulated twin of a rig, for a dry run.

    Raises
    ------
    InputError
        The configuration names none.
    """
    if isinstance(settings, SimulatedRigSettings):
        return settings
    twin = getattr(settings, "twin", None)
    if isinstance(twin, TwinSettings):
        return SimulatedRigSettings(
            kind="simulated", **{name: getattr(twin, name) for name in PlantSettings.model_fields}
        )
    raise InputError(
        "the rig has no simulated twin",
        where="rig.twin",
        remedy='name its plant, [rig.twin] plant = "ball", or its model = "FILE.toml"',
    )
