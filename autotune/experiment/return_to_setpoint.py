"""Before a rig's own controller gets the actuator back: y is brought to its set-point."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import median

from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import Oscillation
from autotune.experiment.preflight import Known
from autotune.experiment.rig import HandsBack, Rig

#: distance from the set-point, as a part of limits.swing, that counts as there; noise is added
NEAR = 0.05
#: part of limits.swing that a set-point may be from the operating point for y to be brought to it
REACH = 0.5
#: amplitude of the relay that brings y there, as a part of the sweep's, and half periods that it is given
GENTLE, HALF_PERIODS = 0.25, 12


def setpoint_before(rig: Rig, operating_y: float, swing: float) -> float:
    """Return where y is to be when the rig's own controller gets the actuator back [y unit].

    Parameters
    ----------
    rig : Rig
        Open.
    operating_y, swing : float
        Operating point and ``limits.swing`` [y unit].

    Returns
    -------
    float
        Its set-point, the operating point where it does not say; NaN where no controller gets the actuator, or its
        set-point is too far from the operating point for an experiment that may not go there.
    """
    former = rig.former if isinstance(rig, HandsBack) else None
    if former is None:
        return math.nan
    setpoint = former.setpoint if math.isfinite(former.setpoint) else operating_y
    return setpoint if abs(setpoint - operating_y) <= REACH * swing else math.nan


def is_near(loop: ControlLoop, setpoint: float) -> bool:
    """Return whether y is at a set-point, to within the noise and a small part of the swing.

    Parameters
    ----------
    loop : ControlLoop
        Monitors y.
    setpoint : float
        Where y should be [y unit].
    """
    tolerance = NEAR * loop.envelope.settings.swing + loop.monitor.noise / math.sqrt(len(loop.monitor.recent) or 1)
    return abs(median(loop.monitor.recent) - setpoint) <= tolerance


def return_by_relay(loop: ControlLoop, oscillation: Oscillation, known: Known, setpoint: float) -> bool:
    """Let a gentle relay without inserted delay bring y to a set-point; return whether it is there.

    Parameters
    ----------
    loop : ControlLoop
        Open, after the sweep: y is at its extremum.
    oscillation : Oscillation
        The sweep's relay.
    known : Known
        With the sweep's points.
    setpoint : float
        Where y is to be [y unit].
    """
    fastest = max(known.points, key=lambda point: point.omega_rad_s)
    half_s = math.pi / fastest.omega_rad_s
    patience_s = min(HALF_PERIODS * half_s, loop.envelope.settings.time_s - loop.tick.t_s - loop.sample_time_s)
    last = oscillation.settings
    settings = replace(last, y_centre=setpoint, midpoint=known.midpoint, amplitude=GENTLE * last.amplitude)
    oscillation.change(replace(settings, delay_samples=0.0), patience_s=math.inf)
    start_s = loop.tick.t_s
    while not is_near(loop, setpoint):
        if loop.tick.t_s - start_s >= patience_s:
            return False
        oscillation.step()
    return True
