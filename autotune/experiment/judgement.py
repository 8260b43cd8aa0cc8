"""Measured step responses beside the predicted ones: the figures people look at, and the decision."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

import numpy as np
from scipy.ndimage import uniform_filter1d

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.law import PILaw
from autotune.design.margins import Margins, margins
from autotune.errors import DesignError
from autotune.experiment.prediction import Prediction, predict
from autotune.experiment.running_law import RunningLaw
from autotune.experiment.step_test import StepTest
from autotune.identification.parametric import PlantFit

#: plants and noise sequences drawn for the prediction's band
DRAWS = 60
#: part of the predicted departure's rms that unmodelled dynamics may add before the loop counts as another one
TOLERANCE = 0.15
#: share of the test with the command at a limit from which on it is told
AT_LIMIT = 0.1
#: part of the step that an explained error may have: a larger one would explain any loop
VACUOUS = 1.0 / 3.0
#: what to do then
REMEDY = "measure the points again with a longer experiment.budget_s, or allow more limits.swing"
#: probability of so large a chi-square below which the points contradict their covariance, where a point is also
#: further from the plant, relative to its gain, than the tolerance of a verification covers
CONTRADICTED, RESIDUAL = 1e-4, 0.05


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
        Largest departure under the load step [y unit]; NaN where there was none.
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
    by : {"host", "device", "simulation"}
        Whose law ran: the host's, in the place of the rig's own controller, or that controller itself; or the host's on
        a simulated rig, beside which there is no other.
    untried : str
        Why the rig's own controller was not tried, where it was not.
    running_law : RunningLaw or None
        What the rig's own controller computed, from its own y and u; None where it did not run, or did not show it.
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
    by: Literal["host", "device", "simulation"] = "host"
    untried: str = ""
    running_law: RunningLaw | None = None

    @property
    def whose(self) -> str:
        """Say which law was verified."""
        if self.by == "device":
            return "the device's own law verified"
        if self.by == "simulation":
            return "host's law verified on a simulated rig"
        if not self.untried:  # the rig has none
            return "host's law verified"
        return f"host's law verified; the device's own law not tried ({self.untried})"


def contradict(fit: PlantFit) -> bool:
    """Return whether the points contradict the fitted structure by more than their covariance and a tolerance."""
    return fit.p_value < CONTRADICTED and fit.largest_residual > RESIDUAL


def require_predictable(fit: PlantFit, controller: PIDController) -> Margins:
    """Refuse to predict a loop from points that leave open whether it is stable, or that contradict one another.

    Parameters
    ----------
    fit : PlantFit
        Plant for the prediction.
    controller : PIDController
        Gains to be tried.

    Returns
    -------
    Margins
        Of the loop with the estimated plant.

    Raises
    ------
    DesignError
        The loop would be unstable, or have no crossover that its test could be timed by; or a plant that the points
        allow makes it unstable; or the points are further from every structure than their covariance and a fitted
        structure's simplicity explain.
    """

    def refuse(what: str, remedy: str) -> NoReturn:
        raise DesignError(what, where="verification", remedy=f"nothing was tried on the rig; {remedy}")

    expected = margins(fit.plant, controller)
    gains, crossover = f"K = {controller.K:.4g}, T_I = {controller.Ti_s:.4g} s", expected.crossover_rad_s
    if not expected.stable or not math.isfinite(crossover):
        refuse(f"on the measured plant {gains} make no stable loop", "design the controller on this rig's points")
    if contradict(fit):
        refuse(
            f"the points contradict their covariance: chi-square {fit.chi_square:.3g} at {fit.degrees_of_freedom}"
            f" degrees of freedom, a point is {100 * fit.largest_residual:.2g} % from the fitted plant",
            "measure the points again, and look for a load, a drift or an actuator at its limit between them",
        )
    unstable = sum(not margins(plant, controller).stable for plant in fit.draws(DRAWS, np.random.default_rng(0)))
    if unstable:
        refuse(
            f"{unstable} of {DRAWS} plants that the points allow make no stable loop with {gains}",
            f"measure points around {crossover:.3g} rad/s again, with a longer experiment.budget_s or a larger relay",
        )
    return expected


@dataclass(frozen=True, kw_only=True, eq=False)
class Expectation:
    """What a test is expected to show, and how far from it a loop may be.

    Attributes
    ----------
    prediction : Prediction
        Of the test.
    responses : tuple of (N,) arrays
        Drawn responses, smoothed [y unit].
    allowed : float
        Largest rms error that prediction and noise explain [y unit].
    vacuous : str
        Why that error would be no evidence, as nearly any loop keeps it; empty where it is.
    """

    prediction: Prediction
    responses: tuple[FloatArray, ...]
    allowed: float
    vacuous: str


def expectation(
    test: StepTest, law: PILaw, fit: PlantFit, noise_sd: float, *, u_rest: float, seed: int = 0
) -> Expectation:
    """Predict a test, and say which error is explained.

    Parameters
    ----------
    test, law, fit, noise_sd, u_rest, seed : as of judge
        What is asked, what runs, and what is known of the plant.
    """
    rng = np.random.default_rng(seed)
    draws, thin = fit.draws(DRAWS, rng), max(1, round(test.sample_time_s / law.sample_time_s))
    prediction = predict(
        fit.plant, draws, law, test.setpoint, test.disturbance, noise_sd, rng, u_rest=u_rest, thin=thin
    )
    expected = smooth_steps(prediction.y, test)
    responses = tuple(smooth_steps(draw, test) for draw in prediction.y_draws)
    explained = float(np.quantile([_rms(response - expected) for response in responses], 0.99))
    # the response counts from the set-point, where the loop is to bring it
    allowed = math.hypot(explained, TOLERANCE * _rms(expected - test.setpoint))
    step = abs(float(test.setpoint[0]))
    vacuous = ""
    if allowed > VACUOUS * step:
        error, asked = (f"{value:.3g} {test.y_unit}".strip() for value in (allowed, step))
        vacuous = f"an rms error of {error} would be explained at a step of {asked}, a third of it is the most"
    return Expectation(prediction=prediction, responses=responses, allowed=allowed, vacuous=vacuous)


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
    by: Literal["host", "device", "simulation"] = "host",
    untried: str = "",
    running_law: RunningLaw | None = None,
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
    by, untried, running_law
        As of :class:`Verification`.

    Returns
    -------
    Verification
        Accepted where the rms error is within what drawn plants and noise give in 99 % of cases, widened by 15 % of the
        predicted response's rms for dynamics that the fitted structure leaves out; never where a third of the step
        or more would be explained, or where the rig's own controller is seen to compute something else.
    """
    expected = expectation(test, law, fit, noise_sd, u_rest=u_rest, seed=seed)
    usable = np.isfinite(y)
    measured = smooth_steps(np.where(usable, y, np.interp(test.t, test.t[usable], y[usable])), test)
    rms_error = _rms(measured - smooth_steps(expected.prediction.y, test))
    accepted = rms_error <= expected.allowed and not expected.vacuous
    misread = running_law is not None and bool(running_law.misreading)
    drawn = [_figures(test, response) for response in expected.responses]
    reason = _reason(test, expected, rms_error, accepted)
    if running_law is not None and not (accepted and running_law.is_given):
        reason += f"; {running_law.sentence}"
    if (at_limit := _share_at_limit(test, u, law)) > AT_LIMIT:
        reason += f"; the command is at its limit for {100 * at_limit:.0f} % of the steps, where dead time hardly shows"
    return Verification(
        accepted=accepted and not misread,
        reason=reason,
        test=test,
        y=y,
        u=u,
        prediction=expected.prediction,
        rms_error=rms_error,
        allowed=expected.allowed,
        measured=_figures(test, measured),
        predicted=_over(drawn, np.mean),
        predicted_sd=_over(drawn, np.std),
        by=by,
        untried=untried,
        running_law=running_law,
    )


def _reason(test: StepTest, expected: Expectation, rms_error: float, accepted: bool) -> str:
    error, limit = (f"{value:.3g} {test.y_unit}".strip() for value in (rms_error, expected.allowed))
    if expected.vacuous:
        return f"nothing is verified: {expected.vacuous}; {REMEDY}"
    if accepted:
        return f"the loop behaves as predicted: rms error {error}, noise and uncertainty explain {limit}"
    return f"the loop does not behave as predicted: rms error {error}, noise and uncertainty explain only {limit}"


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


def smooth_steps(y: FloatArray, test: StepTest) -> FloatArray:
    """Return the centred moving average over the test's smoothing, step by step so that a step stays a step.

    Parameters
    ----------
    y : (N,) array
        Measured or predicted [y unit].
    test : StepTest
        States the smoothing and the row of the step.

    Returns
    -------
    (N,) array
        The average [y unit].
    """
    split = test.disturbed_from
    parts = (y[:split], y[split:])
    return np.concatenate([uniform_filter1d(part, test.smoothing, mode="nearest") for part in parts])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _figures(test: StepTest, y: FloatArray) -> StepFigures:
    split = test.disturbed_from
    step, load = float(test.setpoint[0]), float(test.disturbance[-1])
    rising, loaded = y[:split] / step, y[split:] - test.setpoint[split:]
    reached = rising >= 0.9
    dt = test.sample_time_s
    return StepFigures(
        overshoot=max(0.0, float(rising.max()) - 1.0),
        rise_s=float(np.argmax(reached)) * dt if reached.any() else math.nan,
        peak=float(np.abs(loaded).max()) if load else math.nan,
        h2=float(np.sqrt(dt * np.sum(loaded**2))) / abs(load) if load else math.nan,
    )
