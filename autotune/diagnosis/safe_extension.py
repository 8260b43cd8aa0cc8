"""An extended model is handed out only where it is no danger: as near as the nominal one, and bounded where that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import TypeVar

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.fitting.fit import RUNAWAY
from autotune.recording import Recording

M = TypeVar("M")

#: Commands, as a multiple of those recorded about their mean, on which a model must stay bounded.
TIMES = 2.0
#: How far it may go there, as a multiple of what the nominal model does and the readings did.
FARTHER = 10.0


def safe_extension(
    models: Sequence[M],
    nominal: M,
    recordings: Sequence[Recording],
    forecast: Callable[[M, Recording], FloatArray],
    *,
    comparable: bool,
    retuned: M | None = None,
) -> M:
    """Return the first of some models that is no danger beside the nominal one; the nominal one where none is.

    Parameters
    ----------
    models : sequence
        What may be handed out, the most wanted first.
    nominal : model
        What the person had.
    recordings : sequence of Recording
        What was measured.
    forecast : callable
        Simulates a model with a recording's u, its start told by the first readings: as ``autotune simulate`` does.
    comparable : bool
        Whether a free run through a recording says how near a model is: not of a plant that does not settle.
    retuned : model, optional
        The nominal model's own structure with other numbers.

    Notes
    -----
    A model must leave no larger squared error than the nominal one on the recordings as a whole, run as a person will
    run it, and stay within ten times the range of the nominal model and the readings on commands that reach
    twice as far from their mean. Where the retuned one is as near and goes farther there, others may go as far: that
    is what the person's own physics says with the right numbers, as of a pendulum that goes over its top, and no danger
    that comes with an extension. Where the nominal model leaves ten times the range of the readings itself, as one of
    an unstable plant does, it sets no bound: how far such runs go depends on every digit of their numbers. What a model
    does on inputs that look otherwise is not known.
    """
    stressed = [_stressed(r) for r in recordings]
    allowed = [_allowed(_reach(nominal, s, forecast), _range(r)) for s, r in zip(stressed, recordings, strict=True)]
    before = sum(_squares(nominal, r, forecast) for r in recordings) if comparable else np.inf

    def is_as_near(model: M) -> bool:
        return not comparable or sum(_squares(model, r, forecast) for r in recordings) <= before

    @cache
    def widened() -> list[float]:
        if not comparable or retuned is None or not is_as_near(retuned):
            return allowed
        reached = (_reach(retuned, s, forecast) for s in stressed)
        return [
            max(most, FARTHER * far if np.isfinite(far) else 0.0) for most, far in zip(allowed, reached, strict=True)
        ]

    def is_bounded(model: M) -> bool:
        reached = [_reach(model, s, forecast) for s in stressed]
        if all(np.less_equal(reached, allowed)):
            return True
        return all(np.less_equal(reached, widened()))  # the retuned one is simulated only where that is asked

    for model in models:
        if is_bounded(model) and is_as_near(model):
            return model
    return nominal


def _allowed(reach: float, span: float) -> float:
    """Return how far a model may go where the nominal one reaches so far, and readings move through a span."""
    return FARTHER * max(reach, span) if reach <= FARTHER * span else np.inf


def _stressed(r: Recording) -> Recording:
    """Return a recording whose commands swing twice as far once the start is told, and that has no readings there."""
    told = np.arange(len(r)) < max(len(r) // 10, 8)
    mean = float(np.mean(r.u))
    return replace(r, u=np.where(told, r.u, mean + TIMES * (r.u - mean)), y=np.where(told, r.y, np.nan))


def _range(r: Recording) -> float:
    y = r.y[np.isfinite(r.y)]
    return float(y.max() - y.min())


def _reach(model: M, r: Recording, forecast: Callable[[M, Recording], FloatArray]) -> float:
    """Return how far a simulation goes from where it begins; infinite where it breaks off."""
    try:
        y = forecast(model, r)
    except RUNAWAY:
        return np.inf
    return float(np.max(np.abs(y - y[0]))) if np.all(np.isfinite(y)) else np.inf


def _squares(model: M, r: Recording, forecast: Callable[[M, Recording], FloatArray]) -> float:
    try:
        e = (r.y - forecast(model, r))[np.isfinite(r.y)]
    except RUNAWAY:
        return np.inf
    return float(e @ e) if np.all(np.isfinite(e)) else np.inf
