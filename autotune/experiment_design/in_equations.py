"""What to record next where a model of equations leaves several hypotheses open."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.equations import EquationDiagnosis
from autotune.diagnosis.equations.bench import Outcome
from autotune.diagnosis.result import NextExperiment, told_apart
from autotune.effects import KINDS as EFFECTS
from autotune.effects import kind_of
from autotune.equations.effects import apply
from autotune.equations.model import EquationModel
from autotune.equations.simulate import Drive, simulate
from autotune.equations.starts import rest_state
from autotune.experiment.excitation import KINDS, Excitation
from autotune.experiment_design.plan import ROOM_SHARE

#: Slowest feature of an excitation as shares of its length, and most rows that are planned.
HOLDS, ROWS = (0.01, 0.03, 0.1), 1000


def with_next_experiment_in_equations(found: EquationDiagnosis) -> EquationDiagnosis:
    """Return a diagnosis with the experiment that would decide most.

    Parameters
    ----------
    found : EquationDiagnosis
        Its verdict, candidates and search.

    Returns
    -------
    EquationDiagnosis
        With ``next_experiment``; none where nothing is open, for a closed model, and for a plant that is compared as
        forecasts, which no command alone keeps in place.

    Notes
    -----
    The hypotheses simulate every kind of excitation within the commands that were recorded, as they were fitted: what
    other numbers could make up for is not counted, so that the discrimination is an upper bound.
    """
    model = found.extended_model
    if found.verdict in ("none", "parameters") or not isinstance(model, EquationModel):
        return found
    for effect in found.effects:
        sits = kind_of(effect.name).may_sit if effect.name in EFFECTS else ()
        if len(sits) > 1:
            return replace(found, next_experiment=_extra_signal(effect.name, sits))
    if model.horizon_s is not None or not any(float(np.ptp(r[model.columns[0]])) > 0.0 for r in found.recordings):
        return found
    # with the further columns that a hypothesis may be driven by
    return replace(found, next_experiment=_planned(found, found.searched.retuned.fitted.compiled.model))


def _extra_signal(name: str, sits: tuple[str, ...]) -> NextExperiment:
    return NextExperiment(
        purpose=f"tell where {name} sits: {', '.join(sits)}",
        kind="extra signal",
        settings={"record": "the actuator's output beside u and y", "excitation": "steps of u"},
        expected="it shows between u and that signal if it is the actuator's, after it if not",
    )


def _open(found: EquationDiagnosis) -> dict[str, tuple[Outcome, float]]:
    """Return the hypotheses that are probable enough, each with its best fit."""
    searched, limits = found.searched, found.searched.limits
    base, best = len(searched.retuned.effects), dict[str, Outcome]()
    for one in (searched.retuned, *searched.tried):
        name = "+".join(e.name for e in one.effects[base:]) or "none"
        if name not in best or searched.score(one) < searched.score(best[name]):
            best[name] = one
    alive = [c for c in found.candidates if c.name in best and c.probability >= limits.still_open]
    return {c.name: (best[c.name], c.probability) for c in alive[: limits.most_open]}


def _planned(found: EquationDiagnosis, model: EquationModel) -> NextExperiment | None:
    """Return the excitation under which the open hypotheses differ most; nothing where there are not two of them."""
    alive = _open(found)
    if len(alive) < 2:
        return None
    noise, most = max(found.searched.noise.total_sd, 1e-300), 0.0
    best: Excitation | None = None
    for excitation, drive in _excitations(found, model):
        runs = [(_simulated(model, one, drive), p) for one, p in alive.values()]
        told = weight = 0.0
        for (a, p), (b, q) in itertools.combinations(runs, 2):
            if np.all(np.isfinite(a)) and np.all(np.isfinite(b)):
                told += p * q * float(np.sum((a - b) ** 2)) / noise**2
                weight += p * q
        if weight and told / weight > most:
            most, best = told / weight, excitation
    if best is None or most < found.searched.limits.least_discrimination:
        return None
    settings = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in best.settings().items()}
    return NextExperiment(
        purpose=told_apart(list(alive)), kind=best.kind, settings=settings,
        expected=f"as fitted, where one is true the others miss it by {most:.3g} noise variances on average",
    )  # fmt: skip


def _excitations(found: EquationDiagnosis, model: EquationModel) -> list[tuple[Excitation, Drive]]:
    """Return what can be done with the command within what was recorded, other inputs at their medians."""
    columns = [np.concatenate([r[name] for r in found.recordings]) for name in model.columns]
    middle = np.array([float(np.median(column)) for column in columns])
    low, high = float(np.min(columns[0])), float(np.max(columns[0]))
    middle[0] = 0.5 * (low + high)
    dt = float(np.median(np.diff(found.recordings[0].t)))
    duration = dt * min(ROWS, *(len(r) for r in found.recordings))
    drives = []
    for kind, share in itertools.product(KINDS, HOLDS):
        one = Excitation(kind=kind, on="command", amplitude=ROOM_SHARE * 0.5 * (high - low), hold_s=share * duration,
                         duration_s=duration)  # fmt: skip
        pattern = one.pattern(dt)
        inputs = np.tile(middle, (pattern.size, 1))
        inputs[:, 0] += pattern
        drives.append((one, Drive(t=dt * np.arange(pattern.size, dtype=np.float64), inputs=inputs)))
    return drives


def _simulated(model: EquationModel, one: Outcome, drive: Drive) -> FloatArray:
    """Return the readings of a hypothesis that begins at rest."""
    compiled, p = one.fitted.compiled, one.fitted.parameters
    applied = apply(model, one.effects)
    start = rest_state(compiled, p, drive.inputs[0], float("nan"))
    return np.asarray(applied.after(simulate(compiled, p, applied.before(drive), start[None, :]).y))
