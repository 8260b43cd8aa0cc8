"""A search in some windows of long recordings is confirmed on all of them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit, fit
from autotune.diagnosis.fitting.retuning import at_nominal
from autotune.diagnosis.selection.hypothesis import Hypothesis, penalised
from autotune.diagnosis.selection.parsimony import settled
from autotune.diagnosis.selection.polishing import states_for
from autotune.diagnosis.selection.searched import Search
from autotune.effects import STRUCTURES

#: Steps of a fit that is carried from some windows on to all.
STEPS = 6


def confirmed(found: Search, pool: Executor) -> Search:
    """Return a search in some windows with its best hypotheses fitted to all rows.

    Parameters
    ----------
    found : Search
        What was searched; it is returned as it is where that was all rows.
    pool : Executor
        Where fits run.

    Notes
    -----
    Nothing is searched again: among the best hypotheses the one is chosen that all rows ask for. Where some windows
    asked for no effect, all rows name none either.
    """
    if found.data.whole is None:
        return found
    data = replace(found.data.whole, noise=found.data.noise, thresholds=found.data.thresholds)
    base = _carried(found.retuned.fit, data, None)
    retuned = Hypothesis(names=(), fit=base)
    ranked = sorted(found.all, key=lambda h: (h is not found.chosen, penalised(h)))
    leading = [h for h in ranked if h.names][: data.thresholds.confirmed]
    whole = [h for h in pool.map(lambda h: _on_all(h, data, base), leading) if h is not None]
    chosen = next((h for h in whole if found.chosen.names and h.names == found.chosen.names), retuned)
    if chosen is not retuned:
        able = [h for h in whole if not STRUCTURES.keys() & set(h.names)]
        chosen = settled(chosen, (retuned, *able), data, base)
    return replace(
        found, data=data, nominal=at_nominal(base, data, STEPS), retuned=retuned, chosen=chosen,
        singles=_of_size(1, whole), pairs=_of_size(2, whole), triples=_of_size(3, whole),
    )  # fmt: skip


def _of_size(size: int, found: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    return tuple(sorted((h for h in found if len(h.names) == size), key=penalised))


def _on_all(h: Hypothesis, data: Data, base: Fit) -> Hypothesis | None:
    """Fit a hypothesis to all rows; nothing where its simulation runs away there."""
    try:
        return replace(h, fit=_carried(h.fit, data, base))
    except RUNAWAY:
        return None


def _carried(result: Fit, data: Data, base: Fit | None) -> Fit:
    """Return a fit to some windows carried on to all: the start states of the others first, then everything."""
    p, held = result.parametrisation, np.zeros(result.theta.size, dtype=bool)
    begun = fit(p, data, result.theta, states_for(result, data, base), free=held, iterations=STEPS, rounds=1)
    return fit(p, data, begun.theta, begun.x0, iterations=STEPS, rounds=1)
