"""The next experiment: what to record to tell apart what the recordings leave open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.diagnosis.result import FoundEffect, NextExperiment, Verdict
from autotune.diagnosis.search import score
from autotune.diagnosis.selection import Search
from autotune.diagnosis.simulation import entry_of


def next_experiment(found: Search, effects: Sequence[FoundEffect], verdict: Verdict) -> NextExperiment | None:
    """Return the experiment that would decide most, None where nothing is open.

    Parameters
    ----------
    found : Search
        Hypotheses with their fits.
    effects : sequence of FoundEffect
        What was named.
    verdict : str
        The verdict.
    """
    if verdict in ("none", "parameters"):
        return None
    for effect in effects:
        if len(effect.places) > 1:
            return _extra_signal(effect)
    ranked = sorted((h for h in (*found.singles, *found.pairs) if h.names), key=score)
    if verdict == "unexplained" or (len(ranked) > 1 and score(ranked[1]) - score(ranked[0]) < 20.0):
        return _larger_swing(found, [" + ".join(h.names) for h in ranked[:2]])
    return None


def _extra_signal(effect: FoundEffect) -> NextExperiment:
    entry = entry_of(effect.name)
    others = ", ".join(effect.places)
    if "lag" in effect.name or effect.name in ("timing.dead_time", "plant.resonance"):
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
        expected=f"{entry.equation}: the plant's input shows it if the actuator makes it, not if the environment does",
    )


def _larger_swing(found: Search, names: list[str]) -> NextExperiment:
    u = np.concatenate([r.u for r in found.data.recordings])
    middle, span = float(np.median(u)), float(np.ptp(u))
    lag = 1.0 / max(float(np.min(np.abs(np.linalg.eigvals(found.chosen.fit.sim.chain.A)) + 1e-9)), 1e-6)
    return NextExperiment(
        purpose="tell " + " from ".join(names) if len(names) > 1 else "see where the misfit comes from",
        kind="staircase",
        settings={
            "levels": [round(middle + share * span, 6) for share in (-0.5, -0.25, 0.0, 0.25, 0.5)],
            "hold_s": round(min(5.0 * lag, 0.2 * found.data.recordings[0].duration_s), 3),
        },
        expected="gain, lag and start-up delay at every level and in both directions: what depends on level, on speed, "
        "on direction or on time shows separately",
    )
