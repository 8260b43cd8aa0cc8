"""What to record next where a model of equations leaves several hypotheses open."""

from __future__ import annotations

import itertools

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.equations.bench import Outcome
from autotune.diagnosis.equations.judged import JudgedEquations
from autotune.diagnosis.result import Diagnosis, NextExperiment, told_apart
from autotune.equations.effects import apply
from autotune.equations.model import EquationModel
from autotune.equations.rest import rest_state
from autotune.equations.simulate import Drive, simulate
from autotune.experiment.excitation import KINDS, Excitation
from autotune.experiment_design.plan import ROOM_SHARE

#: Slowest feature of an excitation as shares of its length, and most rows that are planned.
HOLDS, ROWS = (0.01, 0.03, 0.1), 1000


def plan_in_equations(found: Diagnosis) -> NextExperiment | None:
    """Return the excitation under which the open hypotheses of equations differ most.

    Parameters
    ----------
    found : Diagnosis
        Its candidates and search.

    Returns
    -------
    NextExperiment or None
        Nothing where there are not two of them, for a closed model, and for a plant that is compared as forecasts,
        which no command alone keeps in place.

    Notes
    -----
    The hypotheses simulate every kind of excitation within the commands that were recorded, as they were fitted: what
    other numbers could make up for is not counted, so that the discrimination is an upper bound.
    """
    given = found.search.model
    if not isinstance(given, EquationModel) or given.horizon_s is not None:
        return None
    # with the further columns that a hypothesis may be driven by
    return _plan(found, found.search.found.retuned.outcome.fitted.compiled.model)


def _open(found: Diagnosis) -> dict[str, tuple[Outcome, float]]:
    """Return the hypotheses that are probable enough, each with its best fit."""
    searched, limits, score = found.search.found, found.search.limits, found.search.score
    best: dict[str, JudgedEquations] = {}
    for one in (searched.retuned, *searched.others):
        name = "+".join(one.names) or "none"
        if name not in best or score(one) < score(best[name]):
            best[name] = one
    alive = [c for c in found.candidates if c.name in best and c.probability >= limits.unknown_odds]
    return {c.name: (best[c.name].outcome, c.probability) for c in alive[: limits.leading]}


def _plan(found: Diagnosis, model: EquationModel) -> NextExperiment | None:
    """Return the excitation under which the open hypotheses differ most; nothing where there are not two of them."""
    alive = _open(found)
    if len(alive) < 2:
        return None
    noise, most = max(found.search.found.best.noise.total_sd, 1e-300), 0.0
    best: Excitation | None = None
    for excitation, drive in _excitations(found, model):
        runs = [(_simulate(model, one, drive), p) for one, p in alive.values()]
        told = weight = 0.0
        for (a, p), (b, q) in itertools.combinations(runs, 2):
            if np.all(np.isfinite(a)) and np.all(np.isfinite(b)):
                told += p * q * float(np.sum((a - b) ** 2)) / noise**2
                weight += p * q
        if weight and told / weight > most:
            most, best = told / weight, excitation
    if best is None or most < found.search.limits.beyond_chance:
        return None
    settings = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in best.settings().items()}
    return NextExperiment(
        purpose=told_apart(list(alive)), kind=best.kind, settings=settings,
        expected=f"as fitted, where one is true the others miss it by {most:.3g} noise variances on average",
    )  # fmt: skip


def _excitations(found: Diagnosis, model: EquationModel) -> list[tuple[Excitation, Drive]]:
    """Return what can be done with the command within what was recorded, other inputs at their medians."""
    columns = [np.concatenate([r[name] for r in found.search.recordings]) for name in model.columns]
    middle = np.array([float(np.median(column)) for column in columns])
    low, high = float(np.min(columns[0])), float(np.max(columns[0]))
    middle[0] = 0.5 * (low + high)
    dt = float(np.median(np.diff(found.search.recordings[0].t)))
    duration = dt * min(ROWS, *(len(r) for r in found.search.recordings))
    drives = []
    for kind, share in itertools.product(KINDS, HOLDS):
        one = Excitation(kind=kind, on="command", amplitude=ROOM_SHARE * 0.5 * (high - low), hold_s=share * duration,
                         duration_s=duration)  # fmt: skip
        pattern = one.pattern(dt)
        inputs = np.tile(middle, (pattern.size, 1))
        inputs[:, 0] += pattern
        drives.append((one, Drive(t=dt * np.arange(pattern.size, dtype=np.float64), inputs=inputs)))
    return drives


def _simulate(model: EquationModel, one: Outcome, drive: Drive) -> FloatArray:
    """Return the readings of a hypothesis that begins at rest."""
    compiled, p = one.fitted.compiled, one.fitted.parameters
    applied = apply(model, one.effects)
    start = rest_state(compiled, p, drive.inputs[0], float("nan"))
    return np.asarray(applied.after(simulate(compiled, p, applied.before(drive), start[None, :]).y))
