"""Rows whose reading is spoiled, found before a search and beside it, whatever the model is."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from autotune.arrays import BoolArray
from autotune.diagnosis.evidence.readings import outlying_rows
from autotune.diagnosis.evidence.sample_gain import SimulatedRows, select_supported
from autotune.diagnosis.evidence.samples import SampleEffect, inspect, join_outliers, outliers_in
from autotune.diagnosis.thresholds import Thresholds
from autotune.recording import Recording

T = TypeVar("T")


def clear_samples(
    recordings: Sequence[Recording],
    without: Collection[str],
    limits: Thresholds,
    retuned_rows: Callable[[Sequence[BoolArray]], SimulatedRows | None],
) -> list[SampleEffect]:
    """Return what the samples show where the retuned model speaks for it clearly.

    Rows at rest and turning points at one level are readings like any other: what spoils none leaves them to the fits.

    Parameters
    ----------
    recordings : sequence of Recording
        What was measured.
    without : collection of str
        Effects that are not looked for.
    limits : Thresholds
        What decides between two findings.
    retuned_rows : callable
        Given the rows that count, returns a simulation with the model's numbers retuned; nothing where it runs away.
    """
    good, seen = inspect(recordings, without, limits)
    if not any(s.rows for s in seen):
        return seen
    run = retuned_rows(good)
    clear = 2.0 * math.log(limits.decided / (1.0 - limits.decided))
    return seen if run is None else [s for s in select_supported(seen, run) if s.speaks > clear]


def search_beside(
    search: Callable[[list[SampleEffect]], tuple[T, SimulatedRows]], seen: list[SampleEffect], without: Collection[str]
) -> tuple[T, list[SampleEffect]]:
    """Return what a search finds, and what the samples show; searched again without spikes that it leaves alone.

    Where the reading moves from row to row by as much as its spikes, it shows only the largest of them, or none.

    Parameters
    ----------
    search : callable
        Given what the samples show, returns what it finds with the rows that its best hypothesis simulates.
    seen : list of SampleEffect
        What the samples show.
    without : collection of str
        Effects that are not looked for.
    """
    found, run = search(seen)
    known = [ok & np.isfinite(e) for ok, e in zip(run.good, run.residuals, strict=True)]
    spikes = outliers_in(run.residuals, run.recordings, known, run.limits)
    if spikes is None or spikes.name in without:
        return found, seen
    beside = [outlying_rows(e, ok, run.limits.spike) for e, ok in zip(run.residuals, known, strict=True)]
    spikes = replace(spikes, rows=tuple(a | b for a, b in zip(spikes.rows, beside, strict=True)))
    confirmed = select_supported([join_outliers([*(one for one in seen if one.name == spikes.name), spikes])], run)
    if not confirmed:
        return found, seen
    seen = [*(one for one in seen if one.name != spikes.name), *confirmed]
    return search(seen)[0], seen
