"""Rounds of experiment and diagnosis: run what best separates the open hypotheses, look again, until one is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from autotune.config import Config
from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.result import Diagnosis
from autotune.diagnosis.simulation.assembly import assemble
from autotune.errors import AutotuneError, InputError
from autotune.experiment.excitation import run_excitation
from autotune.experiment.rig import Rig
from autotune.experiment.run import OnStatus
from autotune.experiment_design.conditions import conditions_of
from autotune.experiment_design.next_experiment import with_next_experiment
from autotune.experiment_design.open_hypotheses import only_hypothesis, open_hypotheses
from autotune.experiment_design.plan import Plan, general, plan_in
from autotune.models import Model
from autotune.progress import Progress, quiet
from autotune.recording import Recording, write_recording

#: Share of the longest time on the rig that an excitation may take; the rest is for the way to the operating point.
LARGEST_SHARE = 0.8


@dataclass(frozen=True, kw_only=True)
class Round:
    """One experiment and the probabilities after it.

    Attributes
    ----------
    number : int
        From 1 on.
    recording : str
        File of the rows under excitation; those before are in ``rig_N.csv``.
    plan : Plan
        What was run, and why; ``between`` is empty for the general experiment that begins.
    verdict : str
        Verdict over all recordings so far.
    candidates : tuple of (str, float)
        Hypotheses with their probabilities.
    """

    number: int
    recording: str
    plan: Plan
    verdict: str
    candidates: tuple[tuple[str, float], ...]

    def as_json(self) -> dict[str, Any]:
        """Return the round as a table of rounds.json."""
        excitation = self.plan.excitation
        return {
            "round": self.number,
            "recording": self.recording,
            "between": list(self.plan.between),
            "expected_discrimination": self.plan.discrimination,
            "kind": excitation.kind,
            "settings": excitation.settings(),
            "verdict": self.verdict,
            "candidates": [{"name": name, "probability": p} for name, p in self.candidates],
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Investigation:
    """What is known, how it was learnt, and why it ended.

    Attributes
    ----------
    diagnosis : Diagnosis, optional
        Over all recordings; none where the first experiment was stopped.
    recordings : tuple of Recording
        Those diagnosed, in order.
    before : tuple of (str, float)
        Candidates before the first round, none where there were no recordings.
    rounds : tuple of Round
        Experiments that were run to their end.
    ended : str
        Why no further one was run; empty while it goes on.
    """

    diagnosis: Diagnosis | None
    recordings: tuple[Recording, ...]
    before: tuple[tuple[str, float], ...]
    rounds: tuple[Round, ...]
    ended: str

    def as_json(self) -> dict[str, Any]:
        """Return the content of rounds.json."""
        return {
            "schema": 1,
            "recordings": [r.name for r in self.recordings],
            "before": [{"name": name, "probability": p} for name, p in self.before],
            "rounds": [r.as_json() for r in self.rounds],
            "ended": self.ended,
        }


@dataclass(frozen=True, kw_only=True)
class Budget:
    """What an investigation may take.

    Attributes
    ----------
    rounds : int
        Most experiments.
    duration_s : float, optional
        Time under excitation per round [s]; the experiment's budget of the configuration by default.
    rig_time_s : float, optional
        Time under excitation in all [s]; as many rounds as asked for by default.
    """

    rounds: int = 3
    duration_s: float | None = None
    rig_time_s: float | None = None

    def of(self, config: Config) -> tuple[float, float]:
        """Return the time under excitation per round and in all [s].

        Raises
        ------
        InputError
            A round leaves too little time for the way to the operating point.
        """
        duration_s = config.experiment.budget_s if self.duration_s is None else self.duration_s
        if duration_s > LARGEST_SHARE * config.limits.time_s:
            raise InputError(
                f"{duration_s:g} s under excitation leave too little of limits.time_s = {config.limits.time_s:g} s",
                where="--duration",
                remedy=f"ask for at most {LARGEST_SHARE * config.limits.time_s:.4g} s, or raise limits.time_s",
            )
        return duration_s, self.rounds * duration_s if self.rig_time_s is None else self.rig_time_s


@dataclass(frozen=True, kw_only=True)
class Listeners:
    """Who is told what.

    Attributes
    ----------
    report, on_status : callable
        Told what is being computed, and where the rig is.
    keep : callable
        Given what is known after every diagnosis and at every end, so that nothing is lost.
    """

    report: Progress = quiet
    on_status: OnStatus | None = None
    keep: Callable[[Investigation], None] = lambda known: None


#: Three rounds of the configuration's length, and nobody who listens.
_USUAL, _NOBODY = Budget(), Listeners()


def investigate(
    rig: Rig,
    config: Config,
    model: Model,
    recordings: Sequence[Recording],
    out: Path,
    *,
    budget: Budget = _USUAL,
    without: Sequence[str] = (),
    told: Listeners = _NOBODY,
) -> Investigation:
    """Diagnose, run the experiment that separates the open hypotheses best, and again.

    Parameters
    ----------
    rig : Rig
        Closed; opened and left safe once per round.
    config : Config
        Limits, operating point, present control law.
    model : Model
        Nominal model.
    recordings : sequence of Recording
        What there is already; may be empty.
    out : Path
        Folder for the recordings: ``rig_N.csv`` is everything that the rig saw in round N, ``recording_N.csv`` its
        rows under excitation, which are diagnosed.
    budget : Budget
        Rounds and times.
    without : sequence of str
        Effects left out of the catalogue.
    told : Listeners
        Who is told what is computed, where the rig is, and what is known.

    Returns
    -------
    Investigation

    Raises
    ------
    InputError
        No excitation fits into the limits or the time, or an integrating plant without a stated law.
    ExperimentStopped, LinkError, OperatorStop
        What ended a round; the rig is safe, and what was known before has been kept.
    """
    budget.of(config)
    found = _diagnose(model, recordings, without, told.report) if recordings else None
    before = () if found is None else _probabilities(found)
    known = Investigation(diagnosis=found, recordings=tuple(recordings), before=before, rounds=(), ended="")
    while True:
        told.keep(known)
        plan, ended = _next(known, config, model, budget, told.report)
        if plan is None:
            known = replace(known, ended=ended)
            told.keep(known)
            return known
        known = _round(known, plan, rig, config, model, out, without, told)


def _next(
    known: Investigation,
    config: Config,
    model: Model,
    budget: Budget,
    report: Progress,
) -> tuple[Plan | None, str]:
    """Return the next experiment, or why there is none."""
    rounds, (duration_s, rig_time_s) = budget.rounds, budget.of(config)
    done = len(known.rounds)
    found = known.diagnosis
    if found is None:
        first = general(assemble(model), conditions_of(config), duration_s)
        return Plan(excitation=first, between=(), discrimination=0.0), ""
    hypotheses, best = open_hypotheses(found), only_hypothesis(found)
    if best == "none":
        return None, "the simulation explains the recordings"
    if best or len(hypotheses) < 2:
        unexplained = "no hypothesis explains the recordings: see the description of what is missing"
        return None, unexplained if found.verdict == "unexplained" else f"one hypothesis is left: {best}"
    if done >= rounds:
        return None, f"{rounds} round(s) were asked for, {len(hypotheses)} hypotheses are left"
    if (done + 1) * duration_s > rig_time_s * (1.0 + 1e-9):
        return None, f"the rig time of {rig_time_s:g} s is used up, {len(hypotheses)} hypotheses are left"
    plan = plan_in(found, conditions_of(config), duration_s, seed=done + 1, progress=report)
    if plan is None or plan.discrimination < found.search.data.thresholds.beyond_chance:
        told = 0.0 if plan is None else plan.discrimination
        names = ", ".join("nothing else is missing" if name == "none" else name for name in hypotheses)
        return None, f"no experiment within the limits tells these apart (expected chi-square {told:.2g}): {names}"
    return plan, ""


def _round(
    known: Investigation,
    plan: Plan,
    rig: Rig,
    config: Config,
    model: Model,
    out: Path,
    without: Sequence[str],
    told: Listeners,
) -> Investigation:
    """Run one experiment and diagnose everything again."""
    number = len(known.rounds) + 1
    try:
        seen = run_excitation(rig, config, out / f"rig_{number}.csv", plan.excitation, on_status=told.on_status)
    except AutotuneError as error:
        told.keep(replace(known, ended=f"round {number}: {error}"))
        raise
    path = out / f"recording_{number}.csv"
    write_recording(seen, path)
    recordings = (*known.recordings, replace(seen, name=str(path)))
    found = _diagnose(model, recordings, without, told.report)
    one = Round(
        number=number, recording=path.name, plan=plan, verdict=found.verdict, candidates=_probabilities(found)
    )  # fmt: skip
    return replace(known, diagnosis=found, recordings=recordings, rounds=(*known.rounds, one))


def _diagnose(model: Model, recordings: Sequence[Recording], without: Sequence[str], report: Progress) -> Diagnosis:
    return with_next_experiment(diagnose(model, recordings, None, without, report))


def _probabilities(found: Diagnosis) -> tuple[tuple[str, float], ...]:
    return tuple((c.name, round(c.probability, 4)) for c in found.candidates)
