"""Which experiment tells the hypotheses apart that are still open: predicted by each, refitted by every other.

The expected discrimination of an experiment between i and j is T_ij: the least chi-square of j for what i predicts,
with j's numbers held by what the recordings so far have told of them
(T-optimality, Atkinson and Fedorov). The experiment is chosen that has the largest mean of T over all pairs, weighted
with their probabilities.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit
from autotune.diagnosis.fitting.windows import model_lag_s, window_rows
from autotune.diagnosis.result import Diagnosis
from autotune.diagnosis.selection.hypothesis import Hypothesis
from autotune.diagnosis.simulation.simulator import Simulator
from autotune.diagnosis.simulation.transitions import transition_table
from autotune.errors import InputError
from autotune.experiment.excitation import KINDS, Excitation, On
from autotune.experiment.limits import Envelope
from autotune.experiment.verify import law_for
from autotune.experiment_design.conditions import Conditions
from autotune.experiment_design.open_hypotheses import open_hypotheses
from autotune.poles import slowest_lag_s
from autotune.progress import Progress, quiet
from autotune.recording import Recording

#: Shares of the allowed swing and of the command's room that a planned excitation takes.
SWING_SHARE, ROOM_SHARE = 0.5, 0.8
#: Slowest feature of an excitation, in time constants of the loop.
HOLDS = 2.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """An experiment with what it is expected to tell.

    Attributes
    ----------
    excitation : Excitation
        What to do on the rig.
    between : tuple of str
        The hypotheses that it tells apart.
    discrimination : float
        Expected mean chi-square of one where another is true.
    """

    excitation: Excitation
    between: tuple[str, ...]
    discrimination: float


def plan_in(
    found: Diagnosis,
    conditions: Conditions,
    duration_s: float,
    seed: int = 0,
    progress: Progress = quiet,
) -> Plan | None:
    """Return the experiment that best separates the open hypotheses within the limits, None where none is safe.

    Parameters
    ----------
    found : Diagnosis
        What is known so far.
    conditions : Conditions
        Limits, operating point, and the present control law where there is one.
    duration_s : float
        Time under excitation [s].
    seed : int
        Of random patterns.
    progress : callable
        Told what is being done and the share done, 0 to 1.
    """
    hypotheses = open_hypotheses(found)
    base = found.search.retuned.fit
    plans = []
    choices = excitations(base.sim, conditions, duration_s, seed)
    for i, one in enumerate(choices):
        progress(f"looking what {one.kind} would tell", i / len(choices))
        plans += _within_swing(found, hypotheses, conditions, one)
    return max(plans, key=lambda plan: plan.discrimination, default=None)


def _within_swing(
    found: Diagnosis, hypotheses: dict[str, tuple[Hypothesis, float]], conditions: Conditions, one: Excitation
) -> list[Plan]:
    """Return the plan of an excitation, made smaller where a hypothesis predicts more than the allowed swing."""
    for share in (1.0, 0.5, 0.25):
        smaller = replace(one, amplitude=float(f"{share * one.amplitude:.4g}"))
        planned = predict_recording(found.search.retuned.fit.sim, conditions, smaller)
        if planned is None:
            continue
        plan, y = _rate_excitation(found, hypotheses, smaller, planned)
        if np.max(np.abs(y - conditions.y), initial=0.0) <= conditions.limits.swing:
            return [plan]
    return []


def excitations(sim: Simulator, conditions: Conditions, duration_s: float, seed: int = 0) -> list[Excitation]:
    """Return every excitation that may be run, as large as the limits allow by the linear prediction.

    Parameters
    ----------
    sim : Simulator
        The nominal model, whose linear response sets the sizes.
    conditions : Conditions
        Present law, sample time and limits.
    duration_s : float
        Length of each experiment [s].
    seed : int
        Of what is random in them.

    Raises
    ------
    InputError
        An integrating plant without a stated control law: a held command would let it run away.
    """
    if conditions.law is None and sim.chain.is_integrating:
        raise InputError(
            "the plant integrates and no present control law is stated",
            where="[controller]",
            remedy="write K and Ti_s of the loop as it is now",
        )
    dt, limits = conditions.sample_time_s, conditions.limits
    slow = _slowest_s(sim, conditions)
    hold = min(max(HOLDS * slow, 4.0 * dt), duration_s / 8.0)
    where: tuple[On, ...] = ("set-point", "command") if conditions.law is not None else ("command",)
    unit: dict[On, float] = {"set-point": 0.1 * limits.swing, "command": 0.02 * (limits.u_max - limits.u_min)}
    found = []
    for on, kind in itertools.product(where, KINDS):
        if on == "set-point" and kind in ("pulses", "sweep"):
            continue  # the law smooths what is fast; the command carries it unchanged
        trial = Excitation(kind=kind, on=on, amplitude=unit[on], hold_s=hold, duration_s=duration_s, seed=seed)
        scale = _scale_to_limits(sim, conditions, trial)
        if scale > 0.0:
            found.append(replace(trial, amplitude=float(f"{scale * trial.amplitude:.4g}")))
    return found


def _slowest_s(sim: Simulator, conditions: Conditions) -> float:
    """Return the slowest time constant of the loop under the present law, of the plant where none is stated [s]."""
    A, b, c = sim.chain.A, sim.chain.B[:, :1], sim.chain.taps[3:4]
    if conditions.law is not None:
        K, Ti = conditions.law.K, conditions.law.Ti_s
        A = np.block([[A - K * b @ c, b * K / Ti], [-c, np.zeros((1, 1))]])
    return slowest_lag_s(np.linalg.eigvals(A))


def _scale_to_limits(sim: Simulator, conditions: Conditions, trial: Excitation) -> float:
    """Return the factor at which a trial excitation takes its share of the limits, by the linear prediction."""
    limits, centre = conditions.limits, conditions.y
    planned = predict_recording(sim, conditions, trial, unlimited=True)
    if planned is None:
        return 0.0
    u_hold = float(planned.u[0])
    room_y = SWING_SHARE * min(limits.swing, limits.y_max - centre, centre - limits.y_min)
    room_u = ROOM_SHARE * min(limits.u_max - u_hold, u_hold - limits.u_min)
    moved_y, moved_u = float(np.max(np.abs(planned.y - centre))), float(np.max(np.abs(planned.u - u_hold)))
    return max(0.0, min(room_y / max(moved_y, 1e-300), room_u / max(moved_u, 1e-300)))


def predict_recording(
    sim: Simulator, conditions: Conditions, excitation: Excitation, *, unlimited: bool = False
) -> Recording | None:
    """Return what the linear chain would record under an excitation, None where its loop runs away.

    Parameters
    ----------
    sim : Simulator
        Its chain and operating point; effects are left aside.
    conditions : Conditions
        Control law, limits, sample time.
    excitation : Excitation
        What is done.
    unlimited : bool
        Whether the limits are left aside, so that the answer is in proportion to the excitation.
    """
    dt, centre, chain, limits = conditions.sample_time_s, conditions.y, sim.chain, conditions.limits
    envelope = Envelope(settings=limits, sample_time_s=dt, u_step=conditions.u_step)
    step = transition_table(chain.A, chain.B, dt, 1)[1]
    Ad, Bd, c = step[:, : chain.order], step[:, chain.order], chain.taps[3]
    x, w_hold = sim.rest_at(centre)
    u_hold = w_hold + sim.u_offset
    pattern = excitation.pattern(dt)
    y, u = np.empty(pattern.size), np.empty(pattern.size)
    late = [w_hold] * (1 + round(chain.delay_s / dt))
    law = state = None
    if conditions.law is not None:
        wide = limits.model_copy(update={"u_min": -1e12, "u_max": 1e12, "u_rate": 1e12}) if unlimited else limits
        law = law_for(conditions.law, wide, dt)
        state = law.initial(u_hold, centre, centre)
    before = u_hold
    for k, added in enumerate(pattern):
        y[k] = float(c @ x) + chain.gains[3] * late[0] + sim.y_offset
        if not abs(y[k] - centre) < 1e3 * (abs(centre) + limits.swing):
            return None
        base, on_r = u_hold, excitation.on == "set-point"
        if law is not None and state is not None:
            base, state = law.step(state, centre + (added if on_r else 0.0), y[k])
        wanted = base + (0.0 if on_r else added)
        before = u[k] = wanted if unlimited else envelope.nearest(wanted, before)
        late = [*late[1:], u[k] - sim.u_offset]
        x = Ad @ x + Bd * late[0]
    return Recording(t=np.asarray(dt * np.arange(pattern.size)), u=u, y=y)


def _rate_excitation(
    found: Diagnosis, hypotheses: dict[str, tuple[Hypothesis, float]], one: Excitation, planned: Recording
) -> tuple[Plan, FloatArray]:
    """Return an excitation with its expected discrimination, and all readings that the hypotheses predict."""
    model, limits = found.search.retuned.fit.model, found.search.data.thresholds
    starts, stops = window_rows(planned, limits.lags_per_window * model_lag_s(model), float(planned.t[0]), limits)
    data = Data(
        recordings=(planned,), good=(np.ones(len(planned), dtype=bool),), starts=(starts,), stops=(stops,),
        noise=found.search.data.noise, thresholds=limits, numbers=(len(found.search.data.recordings),),
    )  # fmt: skip
    predicted: dict[str, FloatArray] = {}
    for name, (h, _) in hypotheses.items():
        y = _prediction(h.fit, data)
        if y is not None:
            predicted[name] = y
    T = {
        (i, j): _least_chi2(hypotheses[j][0].fit, replace(data, recordings=(replace(planned, y=predicted[i]),)))
        for i, j in itertools.permutations(predicted, 2)
    }
    certain = limits.certain
    weights = {(i, j): hypotheses[i][1] * hypotheses[j][1] for i, j in T}
    total = sum(weights.values())
    mean = sum(weights[pair] * min(T[pair], certain) for pair in T) / total if total > 0.0 else 0.0
    plan = Plan(excitation=one, between=tuple(hypotheses), discrimination=mean)
    return plan, np.concatenate([planned.y, *predicted.values()])


def _prediction(result: Fit, data: Data) -> FloatArray | None:
    """Return what a fitted hypothesis predicts for planned commands, its start states near the linear plan."""
    try:
        none = np.zeros(result.theta.size, dtype=bool)
        return fit(result.parametrisation, data, result.theta, free=none, iterations=4, rounds=1).signals[0][:, 0]
    except RUNAWAY:
        return None


def _least_chi2(result: Fit, data: Data) -> float:
    """Return the least chi-square of a hypothesis for a prediction, its numbers held by what is known of them."""
    p = result.parametrisation
    sd = np.sqrt(np.maximum(np.diag(result.covariance), 1e-12))
    held = replace(
        p, centre=result.theta, free=tuple(replace(f, spread=float(s)) for f, s in zip(p.free, sd, strict=True))
    )
    try:
        return fit(held, data, result.theta, iterations=4, rounds=1).cost
    except RUNAWAY:
        return 0.0  # nothing is known of what it would predict


def general(sim: Simulator, conditions: Conditions, duration_s: float) -> Excitation:
    """Return the experiment to begin with while there is no hypothesis: random steps over many levels and dwells.

    Parameters
    ----------
    sim : Simulator
        The nominal model, whose linear response sets the sizes.
    conditions : Conditions
        Present law, sample time and limits.
    duration_s : float
        Length of the experiment [s].

    Raises
    ------
    InputError
        Nothing fits into the limits.
    """
    choices: Sequence[Excitation] = excitations(sim, conditions, duration_s)
    steps = [one for one in choices if one.kind == "random steps"]
    if not steps:
        raise InputError(
            "no excitation fits into the limits", where="[limits]", remedy="allow more swing, or a wider range of u"
        )
    return steps[0]
