"""The loop with the new controller on the rig: a set-point step and a load step, measured against the prediction."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from autotune.arrays import FloatArray
from autotune.config import Config
from autotune.config.procedure import LimitSettings
from autotune.controller import PIDController
from autotune.design.law import PILaw
from autotune.design.margins import Margins, margins
from autotune.errors import DesignError
from autotune.experiment.device import try_on_device
from autotune.experiment.limits import Watch
from autotune.experiment.loop import ControlLoop
from autotune.experiment.prediction import Prediction, predict
from autotune.experiment.result import State, Status
from autotune.experiment.rig import Exchanges, Rig, RunsLaws
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

#: plants and noise sequences drawn for the prediction's band
DRAWS = 60
#: part of the predicted departure's rms that unmodelled dynamics may add before the loop counts as another one
TOLERANCE = 0.15
#: share of the test with the command at a limit from which on it is told
AT_LIMIT = 0.1


@dataclass(frozen=True, kw_only=True)
class StepFigures:
    """What people look at in a step response.

    Attributes
    ----------
    overshoot : float
        Largest excess over the set-point step, as a share of it.
    rise_s : float
        Time to reach nine tenths of the set-point step [s]; NaN where it is not reached.
    peak : float
        Largest departure under the load step [y unit].
    h2 : float
        Root of the integral of y^2 over the load step, per unit of load: the criterion (11), over this time only.
    """

    overshoot: float
    rise_s: float
    peak: float
    h2: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Verification:
    """The measured loop beside the predicted one, and the decision.

    Attributes
    ----------
    accepted : bool
        Whether the loop behaves as predicted.
    reason : str
        Why, in one sentence.
    test : StepTest
        What was asked.
    y, u : (N,) array
        Measured departure from the operating point [y unit]; the law's command [u unit].
    prediction : Prediction
        What was expected.
    rms_error, allowed : float
        Root mean square of measured less predicted, both smoothed, and the largest that prediction and noise explain
        [y unit].
    measured, predicted : StepFigures
        Of the smoothed measurement, and their means over the drawn plants and noise.
    predicted_sd : StepFigures
        Standard deviation of the figures over the drawn plants and noise.
    """

    accepted: bool
    reason: str
    test: StepTest
    y: FloatArray
    u: FloatArray
    prediction: Prediction
    rms_error: float
    allowed: float
    measured: StepFigures
    predicted: StepFigures
    predicted_sd: StepFigures


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
    every = max(1, round(0.5 / law.sample_time_s))

    def tell(k: int) -> None:
        if on_status is not None and k % every == 0:
            left_s = (count - k) * law.sample_time_s
            message = "steps with the new gains"
            on_status(Status(state=State.VERIFY, elapsed_s=loop.tick.t_s, remaining_s=left_s, message=message))

    if isinstance(loop.rig, RunsLaws):
        while loop.tick.u != (u_next := loop.nearest(u_hold)):
            loop.step(u_next)
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
    return y[test.settle :], u[test.settle :]


def expected_margins(fit: PlantFit, controller: PIDController) -> Margins:
    """Return the margins of the controller on the fitted plant.

    Raises
    ------
    DesignError
        The loop would be unstable, or have no crossover that its test could be timed by.
    """
    expected = margins(fit.plant, controller)
    if not expected.stable or not math.isfinite(expected.crossover_rad_s):
        raise DesignError(
            f"on the measured plant K = {controller.K:.4g}, T_I = {controller.Ti_s:.4g} s make no stable loop",
            where="verification",
            remedy="nothing was tried on the rig; design the controller on this rig's points",
        )
    return expected


def run_verification(
    rig: Rig,
    config: Config,
    controller: PIDController,
    fit: PlantFit,
    recording: str | Path,
    *,
    u_rest: float | None = None,
    noise_sd: float | None = None,
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
    on_status : callable, optional
        Told where the procedure is.

    Raises
    ------
    DesignError
        The loop would be unstable; the rig was not touched.
    ExperimentStopped, LinkError, OperatorStop
        What ended it; the rig is safe and the recording readable.
    """
    law = law_for(controller, config.limits, config.signals.sample_time_s)
    crossover_rad_s = expected_margins(fit, controller).crossover_rad_s
    if isinstance(rig, Exchanges) and not isinstance(rig, RunsLaws):
        fit = _delayed(fit, config.signals.sample_time_s)  # its commands act one sample after what they come from
    test = plan_test(config, law, fit, crossover_rad_s, u_rest)
    extra = ("r", *further_columns(rig))
    writer = RecordingWriter(recording, ("t", "u", "y", *extra), recording_metadata(config))
    with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer, extra=extra) as loop:
        loop.metadata["controller"] = {"kind": controller.kind, "K": controller.K, "Ti_s": controller.Ti_s}
        if config.operating_point.approach == "ramp":
            wait_for_rest(loop)
        known = bring_to_operating_point(loop, config, u_rest=u_rest)
        loop.note(test_start_s=loop.tick.t_s)
        y, u = run_test(loop, law, test, config.operating_point.y, known.midpoint, on_status)
    if isinstance(rig, RunsLaws):
        law = replace(law, u_rate=math.inf)  # the device's own PI has no limit of the rate
    noise_sd = known.noise_sd if noise_sd is None else noise_sd
    return judge(test, y, u, law, fit, noise_sd, u_rest=known.midpoint)


def _delayed(fit: PlantFit, delay_s: float) -> PlantFit:
    parameters = fit.parameters.copy()
    parameters[-1] += delay_s
    plant = replace(fit.plant, delay_s=fit.plant.delay_s + delay_s)
    return replace(fit, plant=plant, parameters=parameters)


def judge(
    test: StepTest,
    y: FloatArray,
    u: FloatArray,
    law: PILaw,
    fit: PlantFit,
    noise_sd: float,
    *,
    u_rest: float,
    seed: int = 0,
) -> Verification:
    """Compare the measured responses with the prediction.

    Parameters
    ----------
    test : StepTest
        What was asked.
    y, u : (N,) array
        From :func:`run_test`.
    law : PILaw
        The law that ran.
    fit : PlantFit
        Estimated plant with its uncertainty.
    noise_sd : float
        Standard deviation of the measurement noise [y unit].
    u_rest : float
        Command that holds the operating point, as it was known before the test [u unit].
    seed : int
        Of the draws.

    Returns
    -------
    Verification
        Accepted where the rms error is within what drawn plants and noise give in 99 % of cases, widened by 15 % of the
        predicted response's rms for dynamics that the fitted structure leaves out.
    """
    rng = np.random.default_rng(seed)
    draws = fit.draws(DRAWS, rng)
    prediction = predict(fit.plant, draws, law, test.setpoint, test.disturbance, noise_sd, rng, u_rest=u_rest)
    usable = np.isfinite(y)
    expected = smoothed(prediction.y, test)
    measured = smoothed(np.where(usable, y, np.interp(test.t, test.t[usable], y[usable])), test)
    responses = [smoothed(draw, test) for draw in prediction.y_draws]
    rms_error = _rms(measured - expected)
    explained = float(np.quantile([_rms(response - expected) for response in responses], 0.99))
    # the response counts from the set-point, where the loop is to bring it
    allowed = math.hypot(explained, TOLERANCE * _rms(expected - test.setpoint))
    accepted = rms_error <= allowed
    drawn = [_figures(test, response) for response in responses]
    error, limit = (f"{value:.3g} {test.y_unit}".strip() for value in (rms_error, allowed))
    reason = (
        f"the loop behaves as predicted: rms error {error}, up to {limit} is explained"
        if accepted
        else f"the loop does not behave as predicted: rms error {error}, only {limit} is explained"
    )
    if (at_limit := _share_at_limit(test, u, law)) > AT_LIMIT:
        reason += f"; the command is at its limit for {100 * at_limit:.0f} % of the steps, where dead time hardly shows"
    return Verification(
        accepted=accepted,
        reason=reason,
        test=test,
        y=y,
        u=u,
        prediction=prediction,
        rms_error=rms_error,
        allowed=allowed,
        measured=_figures(test, measured),
        predicted=_over(drawn, np.mean),
        predicted_sd=_over(drawn, np.std),
    )


def _share_at_limit(test: StepTest, u: FloatArray, law: PILaw) -> float:
    """Return the share of the samples at which the command, the load included, ends at a limit."""
    whole, slack = u + test.disturbance, 1e-3 * (law.u_max - law.u_min)
    return float(np.mean((whole <= law.u_min + slack) | (whole >= law.u_max - slack)))


def _over(drawn: Sequence[StepFigures], statistic: Callable[[list[float]], Any]) -> StepFigures:
    """Return a statistic of every figure over the draws."""
    reached = [figure.rise_s for figure in drawn if math.isfinite(figure.rise_s)]
    return StepFigures(
        overshoot=float(statistic([figure.overshoot for figure in drawn])),
        rise_s=float(statistic(reached)) if reached else math.nan,
        peak=float(statistic([figure.peak for figure in drawn])),
        h2=float(statistic([figure.h2 for figure in drawn])),
    )


def beside(law: PILaw, load: float) -> PILaw:
    """Return the law whose command stays within the limits together with a load that is added to it [u unit]."""
    return law if load == 0.0 else replace(law, u_min=law.u_min - load, u_max=law.u_max - load)


def law_for(controller: PIDController, limits: LimitSettings, sample_time_s: float, reserve: float = 0.0) -> PILaw:
    """Return the law within the safety envelope; ``reserve`` [u unit] is kept, both ways, for what is added to it."""
    return PILaw(
        controller=controller,
        sample_time_s=sample_time_s,
        u_min=limits.u_min + abs(reserve),
        u_max=limits.u_max - abs(reserve),
        u_rate=limits.u_rate,
    )


def smoothed(y: FloatArray, test: StepTest) -> FloatArray:
    """Return the centred moving average over the test's smoothing, step by step so that a step stays a step."""
    split = test.disturbed_from
    parts = (y[:split], y[split:])
    return np.concatenate([uniform_filter1d(part, test.smoothing, mode="nearest") for part in parts])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _figures(test: StepTest, y: FloatArray) -> StepFigures:
    split = test.disturbed_from
    step, load = float(test.setpoint[0]), float(test.disturbance[-1])
    rising, loaded = y[:split] / step, y[split:] - step
    reached = rising >= 0.9
    dt = float(test.t[1] - test.t[0])
    return StepFigures(
        overshoot=max(0.0, float(rising.max()) - 1.0),
        rise_s=float(np.argmax(reached)) * dt if reached.any() else math.nan,
        peak=float(np.abs(loaded).max()),
        h2=float(np.sqrt(dt * np.sum(loaded**2))) / abs(load),
    )
