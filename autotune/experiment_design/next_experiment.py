"""The next experiment: what to record to tell apart what the recordings leave open.

Where hypotheses are left, the experiment is planned as ``autotune investigate`` plans it on a rig, see
:mod:`autotune.experiment_design.plan`, within what the recordings have shown of the rig.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from autotune.diagnosis.equations.shown import EquationSearch
from autotune.diagnosis.result import Diagnosis, FoundEffect, NextExperiment, told_apart
from autotune.effects import kind_of
from autotune.errors import InputError
from autotune.experiment_design.conditions import as_recorded, is_driven
from autotune.experiment_design.in_equations import plan_in_equations
from autotune.experiment_design.open_hypotheses import only_hypothesis, open_hypotheses
from autotune.experiment_design.plan import plan_in

#: Rows of a planned experiment: enough to rank the kinds.
PLANNED_ROWS = 1000


def with_next_experiment(found: Diagnosis) -> Diagnosis:
    """Return a diagnosis with the experiment that would decide most."""
    return replace(found, next_experiment=next_experiment(found))


def next_experiment(found: Diagnosis) -> NextExperiment | None:
    """Return the experiment that would decide most, None where nothing is open.

    Parameters
    ----------
    found : Diagnosis
        Its verdict, effects, candidates and search.
    """
    of_equations = isinstance(found.search, EquationSearch)
    if found.verdict in ("none", "parameters"):
        return None if of_equations or only_hypothesis(found) else _plan(found)
    if not found.places:
        return None
    for effect in found.effects:
        if len(effect.places) > 1:
            return _extra_signal(effect)
    if found.verdict == "effect" and not of_equations and len(open_hypotheses(found)) < 2:
        return None
    planned = _plan(found)
    if planned is None and found.verdict == "unexplained" and is_driven(found) and not of_equations:
        return _larger_swing(found)
    return planned


def _plan(found: Diagnosis) -> NextExperiment | None:
    """Return the experiment that separates the hypotheses alive best; nothing where none does."""
    if isinstance(found.search, EquationSearch):
        return plan_in_equations(found) if is_driven(found) else None
    if len(open_hypotheses(found)) < 2 or not is_driven(found):
        return None
    recorded = as_recorded(found)
    rows = min(PLANNED_ROWS, *(len(r) for r in found.search.recordings))
    try:
        plan = plan_in(found, recorded, rows * recorded.sample_time_s)
    except InputError:  # an integrating plant without a stated law
        return None
    if plan is None or plan.discrimination < found.search.limits.beyond_chance:
        return None
    return NextExperiment(
        purpose=told_apart(plan.between),
        kind=plan.excitation.kind,
        settings={k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in plan.excitation.settings().items()},
        expected=f"where one is true the others miss it by {plan.discrimination:.3g} noise variances on average",
    )


def _extra_signal(effect: FoundEffect) -> NextExperiment:
    kind = kind_of(effect.name)
    others = ", ".join(effect.places)
    if kind.linear is not None and kind.linear.blocks is not None:
        return NextExperiment(
            purpose=f"tell where {effect.name} sits: {others}",
            kind="extra signal",
            settings={"record": "the actuator's output (or u_applied) beside u and y", "excitation": "steps of u"},
            expected="the delay or lag shows between u and that signal if it is the actuator's, after it if not",
        )
    return NextExperiment(
        purpose=f"tell where {effect.name} sits: {others}",
        kind="extra signal",
        settings={"record": "the plant's input beside u and y", "excitation": "u held, then steps"},
        expected=f"{kind.equation}: the plant's input shows it if the actuator makes it, not if the environment does",
    )


def _larger_swing(found: Diagnosis) -> NextExperiment:
    """Return a staircase as wide as the recordings: of the command, of the set-point where the plant integrates."""
    chain, recordings = found.search.chosen.fit.sim.chain, found.search.recordings
    on, name = ("y", "set-point") if chain.is_integrating else ("u", "command")
    values = np.concatenate([getattr(r, on)[np.isfinite(getattr(r, on))] for r in recordings])
    middle, span = float(np.median(values)), float(np.ptp(values))
    rates = np.abs(np.linalg.eigvals(chain.A))
    lag = 1.0 / float(np.min(rates[rates > 1e-6 * rates.max()], initial=math.inf))
    return NextExperiment(
        purpose="see where the mismatch comes from",
        kind="staircase",
        settings={
            "on": name,
            "levels": [_to_digits_of(span, middle + share * span) for share in (-0.5, -0.25, 0.0, 0.25, 0.5)],
            "hold_s": float(f"{min(5.0 * lag, 0.2 * recordings[0].duration_s):.4g}"),
        },
        expected="gain, lag and start-up delay at every level and in both directions: what depends on level, on speed, "
        "on direction or on time shows separately",
    )


def _to_digits_of(span: float, level: float) -> float:
    """Return a level as precisely as its place in a span needs, a thousandth of it."""
    return round(level, 3 - math.floor(math.log10(span))) if span > 0.0 else level
