"""Which steps the loop with the new controller is asked to answer: large enough to show, within the command's room."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.config import Config
from autotune.controller import PIDController
from autotune.design.law import PILaw
from autotune.errors import InputError
from autotune.experiment.prediction import Prediction, predict
from autotune.identification.parametric import PlantFit

#: shares of the command's room for the response to the set-point's step, the rest is for noise, and for the load's step
STEP_ROOM, LOAD_ROOM = 0.8, 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class StepTest:
    """What is asked of the loop, sample by sample, around the operating point.

    Attributes
    ----------
    t : (N,) array
        Time [s]; the first sample is one sample time after the hand-over has settled.
    setpoint, disturbance : (N,) array
        Departure of r from the operating point [y unit]; what is added to the law's command [u unit].
    settle : int
        Samples of regulation before the test, not scored.
    smoothing : int
        Samples over which measured and predicted responses are averaged before they are compared: a third of the
        crossover's radian, which hides noise and leaves the response.
    y_unit : str
        Unit of y, for sentences; empty where nobody said it.
    """

    t: FloatArray
    setpoint: FloatArray
    disturbance: FloatArray
    settle: int
    smoothing: int
    y_unit: str = ""

    @property
    def disturbed_from(self) -> int:
        """First sample of the second step: the load's, or the set-point's way back."""
        changed = (self.disturbance != self.disturbance[0]) | (self.setpoint != self.setpoint[0])
        return int(np.argmax(changed))

    @property
    def sample_time_s(self) -> float:
        """Time between two samples [s]."""
        return float(self.t[1] - self.t[0])

    def asked(self, k: int) -> tuple[float, float]:
        """Return departure of the set-point and load of a sample; none before the first one."""
        return (float(self.setpoint[k]), float(self.disturbance[k])) if k >= 0 else (0.0, 0.0)

    def without_load(self) -> StepTest:
        """Return the test of a loop that takes no load: the set-point's step back comes in its place."""
        back = np.arange(self.t.size) >= self.disturbed_from
        return replace(self, setpoint=np.where(back, 0.0, self.setpoint), disturbance=np.zeros(self.t.size))


def plan_test(
    config: Config, law: PILaw, fit: PlantFit, crossover_rad_s: float, u_rest: float | None = None
) -> StepTest:
    """Choose steps that show well above the noise and stay within half of the allowed swing, and of the command's room.

    A command at its limit answers to nothing: a loop whose dead time is twice the expected one looks as it should.

    Parameters
    ----------
    config : Config
        What is asked for and allowed.
    law : PILaw
        The law to be verified.
    fit : PlantFit
        Estimated plant.
    crossover_rad_s : float
        Gain crossover of the new loop [rad/s], which sets the duration.
    u_rest : float, optional
        Command that holds the operating point [u unit]; the configuration's guess where it is not known.
    """
    count = math.ceil(_duration_s(config, law.controller, crossover_rad_s) / law.sample_time_s)
    step, load = _sizes(config, law, fit, count, u_rest)
    late = np.arange(2 * count) >= count
    return StepTest(
        t=np.arange(2 * count, dtype=np.float64) * law.sample_time_s,
        setpoint=np.full(2 * count, step),
        disturbance=np.where(late, load, 0.0),
        settle=count,
        smoothing=max(1, round(1.0 / (3.0 * crossover_rad_s * law.sample_time_s))),
        y_unit=config.signals.y_unit,
    )


def _duration_s(config: Config, controller: PIDController, crossover_rad_s: float) -> float:
    """Return how long each step is followed [s]."""
    given = config.verification.duration_s
    slow = 4.0 * controller.Ti_s if math.isfinite(controller.Ti_s) else 0.0
    duration = given if given is not None else max(12.0 / crossover_rad_s, slow)
    if 3.0 * duration > config.limits.time_s:
        raise InputError(
            f"the steps take {3.0 * duration:.4g} s on the rig, limits.time_s = {config.limits.time_s:g} allows less",
            where="verification",
            remedy="raise limits.time_s, or give verification.duration_s",
        )
    return duration


def _sizes(config: Config, law: PILaw, fit: PlantFit, count: int, u_rest: float | None) -> tuple[float, float]:
    """Return the step of the set-point [y unit] and that of the load [u unit]."""
    limits, step, load = config.limits, config.verification.setpoint_step, config.verification.disturbance_step
    if u_rest is None or not limits.u_min < u_rest < limits.u_max:
        u_rest = config.operating_point.u_guess
    up, down = limits.u_max - u_rest, u_rest - limits.u_min
    free = replace(law, u_min=-math.inf, u_max=math.inf, u_rate=math.inf)
    quiet, unit = np.zeros(count), np.ones(count)

    def respond(setpoint: FloatArray, disturbance: FloatArray) -> Prediction:
        rng = np.random.default_rng(0)
        return predict(fit.plant, [fit.plant], free, setpoint, disturbance, 0.0, rng, u_rest=u_rest)

    if step is None:
        step = min(limits.swing / 3.0, _within_room(respond(unit, quiet).u, up, down))
    if load is None:
        load = min(0.4 * limits.swing / float(np.abs(respond(quiet, unit).y).max()), LOAD_ROOM * min(up, down))
    return step, load


def _within_room(u: FloatArray, up: float, down: float) -> float:
    """Return the largest factor by which the command's response keeps its room, and at its end that of the load."""
    left = 1.0 - LOAD_ROOM
    ends = (u.max() / (STEP_ROOM * up), -u.min() / (STEP_ROOM * down), u[-1] / (left * up), -u[-1] / (left * down))
    return 1.0 / float(max(ends))
