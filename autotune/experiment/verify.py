"""The loop with the new controller on the rig: a set-point step and a load step, measured against the prediction."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from autotune.arrays import FloatArray
from autotune.config import Config
from autotune.config.procedure import LimitSettings
from autotune.controller import PIDController
from autotune.design.law import LawState, PILaw
from autotune.errors import DesignError
from autotune.experiment.device import try_on_device
from autotune.experiment.judgement import REMEDY, Expectation, Verification, expectation, judge, require_predictable
from autotune.experiment.limits import Watch
from autotune.experiment.loop import ControlLoop
from autotune.experiment.own_law import law_of, try_own_law
from autotune.experiment.result import State, Status
from autotune.experiment.return_to_setpoint import is_near, setpoint_before
from autotune.experiment.rig import Exchanges, HoldsGains, Rig, RunsLaws, RunsOwnController, TrialGains
from autotune.experiment.run import (
    OnStatus,
    bring_to_operating_point,
    envelope_of,
    further_columns,
    recording_metadata,
    wait_for_rest,
)
from autotune.experiment.step_test import StepTest, plan_test
from autotune.identification.parametric import PlantFit
from autotune.recording import RecordingWriter

#: What is said while the device regulates, and where no host takes gains on trial back over a line that is gone.
_OWN_STEPS = "steps of the device's own controller"
_UNGUARDED = ": stay at the rig, it goes on by itself if the line fails"


def run_test(
    loop: ControlLoop,
    law: PILaw,
    test: StepTest,
    operating_y: float,
    u_hold: float,
    on_status: OnStatus | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Close the loop with the new law, bumpless from ``u_hold``, let it settle, and run the test.

    The law is stepped here, or the device's own PI runs on the new gains where the rig lets it.

    Parameters
    ----------
    loop : ControlLoop
        Open, with the rig at its operating point.
    law : PILaw
        The new law.
    test : StepTest
        What to ask.
    operating_y, u_hold : float
        Operating point [y unit] and the command that holds it [u unit].
    on_status : callable, optional
        Told where the test is.

    Returns
    -------
    y, u : (N,) array
        Measurement as a departure from the operating point [y unit], NaN where unusable; the law's command [u unit].

    Raises
    ------
    ExperimentStopped
        From the loop: the new controller took the rig to a limit.
    """
    loop.watch = Watch(y_centre=operating_y, in_range=True)
    count = test.settle + test.t.size
    setpoint = operating_y + np.concatenate([np.zeros(test.settle), test.setpoint])
    load = np.concatenate([np.zeros(test.settle), test.disturbance])
    tell = _teller(loop, count, "steps with the new gains", on_status)
    if isinstance(loop.rig, RunsLaws):
        _hold(loop, u_hold)
        y, u = try_on_device(loop, loop.rig, law.controller, setpoint, load, tell)
        return (y - operating_y)[test.settle :], u[test.settle :]
    y, u = np.full(count, np.nan), np.full(count, np.nan)
    state = law.initial(u_hold, operating_y, operating_y)
    start, k, before = loop.tick.slot, 0, -1
    while (k := loop.tick.slot - start) < count:
        tick = loop.tick
        tell(k)
        y[k] = tick.y - operating_y if tick.usable else np.nan
        for missed in range(before + 1, k + 1):  # the law's time goes on where samples were missed
            u[missed], state = beside(law, float(load[k])).step(state, float(setpoint[k]), tick.y)
        loop.step(loop.nearest(u[k] + load[k]), extra={"r": float(setpoint[k])})
        before = k
    u[before + 1 :] = u[before]
    _return_by_law(loop, law, state, operating_y, test.settle)
    return y[test.settle :], u[test.settle :]


def _return_by_law(loop: ControlLoop, law: PILaw, state: LawState, operating_y: float, most: int) -> None:
    """Bring y to the set-point of the controller that takes over, where one does, within so many samples at most."""
    setpoint = setpoint_before(loop.rig, operating_y, loop.envelope.settings.swing)
    left = int((loop.envelope.settings.time_s - loop.tick.t_s) / loop.sample_time_s) - 1
    for k in range(min(most, left) if math.isfinite(setpoint) else 0):
        # not at once: y goes through the set-point before it stays there
        if k > most // 4 and is_near(loop, setpoint):
            return
        u, state = law.step(state, setpoint, loop.tick.y)
        loop.step(loop.nearest(u), extra={"r": setpoint})


def _hold(loop: ControlLoop, u: float) -> None:
    """Bring the command to a value."""
    while loop.tick.u != (u_next := loop.nearest(u)):
        loop.step(u_next)


def _teller(loop: ControlLoop, count: int, message: str, on_status: OnStatus | None) -> Callable[[int], None]:
    """Return what tells a listener twice a second which of the samples has come."""
    every = max(1, round(0.5 / loop.sample_time_s))

    def tell(k: int) -> None:
        if on_status is not None and k % every == 0:
            left_s = (count - k) * loop.sample_time_s
            on_status(Status(state=State.VERIFY, elapsed_s=loop.tick.t_s, remaining_s=left_s, message=message))

    return tell


def run_verification(
    rig: Rig,
    config: Config,
    controller: PIDController,
    fit: PlantFit,
    recording: str | Path,
    *,
    u_rest: float | None = None,
    noise_sd: float | None = None,
    on_device: bool = False,
    gains: TrialGains | None = None,
    on_status: OnStatus | None = None,
) -> Verification:
    """Bring the rig to its operating point, close the loop with the new controller, test it and leave the rig safe.

    Parameters
    ----------
    rig : Rig
        Closed.
    config : Config
        Limits, operating point, verification.
    controller : PIDController
        New gains.
    fit : PlantFit
        Plant for the prediction.
    recording : path
        CSV to write.
    u_rest, noise_sd : float, optional
        From the experiment: command that holds the operating point [u unit], standard deviation of the noise of y
        [y unit]; found on the way to the operating point where they are not known.
    on_device : bool
        Whether the rig's own controller holds the gains: then it is what is tried, where the host may start it.
    gains : TrialGains, optional
        The gains where that controller does not hold them yet and is to be tried: they are put in right before it gets
        the actuator, and taken out again before it gets it back from the host for good.
    on_status : callable, optional
        Told where the procedure is.

    Raises
    ------
    DesignError
        The points do not say what the loop will do, or too little for a test to tell; the rig was not touched.
    ExperimentStopped, LinkError, OperatorStop
        What ended it; the rig is safe and the recording readable.
    """
    law = law_for(controller, config.limits, config.signals.sample_time_s)
    crossover_rad_s = require_predictable(fit, controller).crossover_rad_s
    if isinstance(rig, Exchanges) and not isinstance(rig, RunsLaws):
        fit = _add_delay(fit, config.signals.sample_time_s)  # its commands act one sample after what they come from
    test = plan_test(config, law, fit, crossover_rad_s, u_rest)
    if noise_sd is not None:
        _require_telling(expectation(test, law, fit, noise_sd, u_rest=config.operating_point.u_guess))
    simulated = config.rig.kind == "simulated"
    own, untried = _own_controller(rig, simulated, on_device or gains is not None)
    extra = ("r", *further_columns(rig))
    writer = RecordingWriter(recording, ("t", "u", "y", *extra), recording_metadata(config))
    y_rest, trial = config.operating_point.y, None
    with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer, extra=extra) as loop:
        loop.metadata["controller"] = {"kind": controller.kind, "K": controller.K, "Ti_s": controller.Ti_s}
        if config.operating_point.approach == "ramp":
            wait_for_rest(loop)
        known = bring_to_operating_point(loop, config, u_rest=u_rest, plant_sign=1 if controller.K > 0.0 else -1)
        loop.note(test_start_s=loop.tick.t_s)
        loop.monitor.commands.ridden_through = 0  # a test that another disturbed says nothing of the gains
        if own is None:
            y, u = run_test(loop, law, test, y_rest, known.midpoint, on_status)
        else:
            _hold(loop, known.midpoint)
            said = _OWN_STEPS + ("" if own.guards_trial else _UNGUARDED)
            tell = _teller(loop, test.settle + test.t.size, said, on_status)
            asked = test if own.takes_load else test.without_load()
            if gains is not None:
                loop.restore = gains.take_out
                loop.hold_while(gains.put_in)
            trial = try_own_law(loop, own, controller, asked, y_rest, tell)
    noise_sd = known.noise_sd if noise_sd is None else noise_sd
    if own is not None and trial is not None:
        law = replace(law, sample_time_s=_scan(own, law.sample_time_s), u_rate=math.inf)
        y, u = trial.record.y[test.settle :] - y_rest, trial.record.u[test.settle :]
        ran = law_of(trial.record, own, controller)
        return judge(trial.test, y, u, law, fit, noise_sd, u_rest=known.midpoint, by="device", running_law=ran)
    if isinstance(rig, RunsLaws):
        law = replace(law, u_rate=math.inf)  # the device's own PI has no limit of the rate
        return judge(test, y, u, law, fit, noise_sd, u_rest=known.midpoint, by="device")
    by: Literal["host", "simulation"] = "simulation" if simulated and not untried else "host"
    return judge(test, y, u, law, fit, noise_sd, u_rest=known.midpoint, by=by, untried=untried)


def _own_controller(rig: Rig, simulated: bool, on_device: bool) -> tuple[RunsOwnController | None, str]:
    """Return the rig where its own controller is to be tried, else why it is not; a simulated rig has none to try."""
    if not isinstance(rig, HoldsGains) or isinstance(rig, RunsLaws):
        return None, ""
    if not isinstance(rig, RunsOwnController):
        return None, "" if simulated else "the host has no means to start it"
    if rig.not_startable:
        return None, rig.not_startable
    return (rig, "") if on_device else (None, "the gains were not in it")


def _scan(rig: RunsOwnController, sample_time_s: float) -> float:
    """Return the device's cycle, as a whole part of the sample time [s]."""
    return sample_time_s / max(1, round(sample_time_s / rig.scan_time_s))


def _require_telling(expected: Expectation) -> None:
    """Refuse a test that nearly any loop would pass, before the rig is touched."""
    if expected.vacuous:
        raise DesignError(
            f"nothing could be verified: {expected.vacuous}",
            where="verification",
            remedy=f"nothing was tried on the rig; {REMEDY}",
        )


def _add_delay(fit: PlantFit, delay_s: float) -> PlantFit:
    parameters = fit.parameters.copy()
    parameters[-1] += delay_s
    plant = replace(fit.plant, delay_s=fit.plant.delay_s + delay_s)
    return replace(fit, plant=plant, parameters=parameters)


def beside(law: PILaw, load: float) -> PILaw:
    """Return the law whose command stays within the limits together with a load that is added to it.

    Parameters
    ----------
    law : PILaw
        The law.
    load : float
        The load [u unit].
    """
    return law if load == 0.0 else replace(law, u_min=law.u_min - load, u_max=law.u_max - load)


def law_for(controller: PIDController, limits: LimitSettings, sample_time_s: float, reserve: float = 0.0) -> PILaw:
    """Return the law within the safety envelope.

    Parameters
    ----------
    controller : PIDController
        Its gains.
    limits : LimitSettings
        Range and rate of the command.
    sample_time_s : float
        Control period [s].
    reserve : float
        What is kept of the range, both ways, for what is added to the law's command [u unit].
    """
    return PILaw(
        controller=controller,
        sample_time_s=sample_time_s,
        u_min=limits.u_min + abs(reserve),
        u_max=limits.u_max - abs(reserve),
        u_rate=limits.u_rate,
    )
