"""All that recordings show of equations or of a closed model: samples, what a search finds, and what is beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.arrays import BoolArray
from autotune.controller import Controller
from autotune.diagnosis.equations.bench import Bench, Outcome
from autotune.diagnosis.equations.equation_proposals import search_equations
from autotune.diagnosis.equations.evidence import EquationEvidence, bench_of, residual_left
from autotune.diagnosis.equations.judged import JudgedEquations
from autotune.diagnosis.evidence.law import law_effect
from autotune.diagnosis.evidence.sample_gain import SimulatedRows, is_material, select_supported
from autotune.diagnosis.evidence.samples import SampleEffect, unspoiled_rows
from autotune.diagnosis.evidence.spoiled_rows import clear_samples, search_beside
from autotune.diagnosis.selection.search import Found
from autotune.diagnosis.thresholds import Thresholds
from autotune.equations.black_box import BlackBox
from autotune.equations.model import EquationModel
from autotune.progress import Progress, quiet
from autotune.recording import Recording


def evidence_of_equations(
    model: EquationModel | BlackBox,
    recordings: Sequence[Recording],
    controller: Controller | None,
    without: Sequence[str],
    progress: Progress,
    limits: Thresholds,
    known: Sequence[JudgedEquations] | None = None,
) -> EquationEvidence:
    """Return all that the verdict rests on: samples, search, the residual, held-out rows.

    Parameters
    ----------
    model, recordings, controller, without, progress, limits
        As in :func:`autotune.diagnosis.diagnose.diagnose`.
    known : sequence of JudgedEquations, optional
        Hypotheses of more rows: they are judged, each from the numbers that it had there, and nothing is searched.

    Raises
    ------
    InputError
        A model that runs away.
    """
    own = {effect.name for effect in model.effects}

    def retuned_rows(good: Sequence[BoolArray]) -> SimulatedRows:
        bench = bench_of(model, recordings, good, limits)
        return _rows_of(bench.retuned(), recordings, bench)

    def searched(seen: list[SampleEffect]) -> tuple[Found[JudgedEquations], SimulatedRows]:
        bench = bench_of(model, recordings, unspoiled_rows(recordings, seen), limits)
        found = search_equations(bench, [*without, *(s.name for s in seen)], progress, known)
        return found, _rows_of(found.chosen.outcome, recordings, bench)

    seen = clear_samples(recordings, [name for name in without if name not in own], limits, retuned_rows)
    found, seen = search_beside(searched, seen, without)
    run = _rows_of(found.chosen.outcome, recordings, found.best.bench)
    samples = [s for s in select_supported(seen, run) if s.name not in own]
    samples = [s for s in samples if not found.chosen.names or is_material(s, run)]
    law = law_effect(recordings, controller, limits)
    samples += [] if law is None or law.name in without else [law]

    return EquationEvidence(
        model=model, given=tuple(recordings), found=found, samples=tuple(samples),
        residual=residual_left(found, samples),
        again=lambda part, more, known: evidence_of_equations(
            model, part, controller, [*without, *more], quiet, limits, known
        ),
    )  # fmt: skip


def _rows_of(outcome: Outcome, recordings: Sequence[Recording], bench: Bench) -> SimulatedRows:
    """Return the rows that a fit simulates."""
    whole = [(np.zeros(1, dtype=np.int64), np.array([len(r)])) for r in recordings]
    windows = [(w.starts, w.stops) for w in outcome.fitted.windows] or whole
    return SimulatedRows(
        recordings=tuple(recordings), good=tuple(np.isfinite(r.y) for r in bench.recordings),
        starts=tuple(a for a, _ in windows), stops=tuple(b for _, b in windows),
        simulated=outcome.fitted.simulated, limits=bench.limits,
    )  # fmt: skip
