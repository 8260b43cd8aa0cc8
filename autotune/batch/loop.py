"""One loop of a campaign: from its record to a row of the table of results."""

from __future__ import annotations

import math
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from autotune.arrays import is_constant
from autotune.batch.operation import look_in_operation, row_of
from autotune.batch.pieces import Record, read_record
from autotune.batch.plant_figures import plant_figures
from autotune.batch.row import Attention, Row
from autotune.batch.settings import CampaignSettings, LoopSettings
from autotune.controller import Controller, PIDController, read_controller
from autotune.design.margins import Margins, margins
from autotune.design.noise import LoopFacts
from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.result import Diagnosis
from autotune.errors import AutotuneError, IdentificationError
from autotune.experiment_design.next_experiment import with_next_experiment
from autotune.identification.answer import require_answer
from autotune.identification.closed_loop.identify import identify_closed_loop
from autotune.identification.closed_loop.loop_plant import loop_plant
from autotune.identification.frequency.recorded import combine, frequency_points
from autotune.identification.frequency.spectral_points import FrequencyEstimate
from autotune.identification.parametric import PlantFit
from autotune.model_file import read_model
from autotune.one_thread import on_one_thread
from autotune.pipeline import Analysis, Measured, analyse, analysis_json, measure_plant
from autotune.points import FrequencyPoint, points_to_json
from autotune.recorded_units import require_units_of_model
from autotune.recording import Recording
from autotune.whole_files import jsonable

#: A controller whose disturbance rejection (11) could be this many times better is worth a look.
_SLUGGISH = 1.5
#: Margins that are missed by less than this share are kept, within what a recording tells.
_TOLERANCE = 0.1


@dataclass(frozen=True, kw_only=True)
class Work:
    """What a worker is given: one loop of a campaign.

    Attributes
    ----------
    loop, settings : LoopSettings, CampaignSettings
        What to do.
    prepared : tuple of Path
        Parquet files that stand for the loop's export.
    """

    loop: LoopSettings
    settings: CampaignSettings
    prepared: tuple[Path, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What a worker gives back.

    Attributes
    ----------
    row : Row
        For the table.
    points : list
        In the form of ``points.json``.
    result : dict
        Of the design or the diagnosis, in the form of their files; empty where there is none.
    """

    row: Row
    points: list[dict[str, Any]] = field(default_factory=list)
    result: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the content of the loop's file."""
        content: dict[str, Any] = jsonable({"row": asdict(self.row), "points": self.points, "result": self.result})
        return content


def analyse_loop(work: Work) -> Finding:
    """Analyse one loop; a failure is a row with its reason.

    Parameters
    ----------
    work : Work
        The loop.

    Returns
    -------
    Finding
        The same on every machine and beside any number of other workers: linear algebra runs on one thread.

    Raises
    ------
    OSError
        A disk or a network drive failed, which may pass.
    """
    loop = work.loop
    row = Row(loop=loop.name, attention="fine", area=loop.area, file=loop.file, u_unit=loop.u_unit, y_unit=loop.y_unit)
    try:
        return _finding(work, row)
    except AutotuneError as error:
        return Finding(row=replace(row, attention="failed", reason=str(error)))
    except OSError:
        raise
    except Exception as error:  # one loop's defect must not end the campaign of all others
        at = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"defect in the tool: {type(error).__name__}: {error} ({Path(at.filename).name} line {at.lineno})"
        return Finding(row=replace(row, attention="failed", reason=reason))


@on_one_thread
def _finding(work: Work, row: Row) -> Finding:
    loop, settings = work.loop, work.settings
    present = _present(loop)
    record = read_record(loop, settings, work.prepared)
    row = replace(
        row,
        rows=record.rows,
        bad_rows=record.bad,
        pieces=len(record.pieces),
        duration_s=sum(piece.duration_s for piece in record.pieces),
        sample_time_s=float(np.median(np.concatenate([np.diff(piece.t) for piece in record.pieces]))),
        notes="; ".join(record.notes),
    )
    pieces = [replace(piece, metadata={**piece.metadata, "units": _units(loop, piece)}) for piece in record.pieces]
    if settings.task == "routine":
        in_operation, notes = look_in_operation(pieces, settings.routine)
        row = replace(_with_notes(row, notes), **row_of(in_operation))
        return Finding(row=row, result=in_operation.as_json())
    if settings.task == "diagnose":
        model = read_model(loop.model)
        require_units_of_model(model, pieces)
        found = with_next_experiment(diagnose(model, pieces, present))
        return Finding(row=_add_diagnosis(row, found), result=found.as_json())
    if settings.task == "design" and settings.method == "frequency":
        measured = measure_plant(record.pieces)
    else:
        points, fit, notes = _points(record, settings, present)
        measured = Measured(points=points, fit=fit, facts=LoopFacts(), notes=notes)
    points, row = measured.points, _with_notes(row, measured.notes)
    row = replace(row, points=len(points))
    if points:
        omega = [point.omega_rad_s for point in points]
        row = replace(row, omega_low_rad_s=min(omega), omega_high_rad_s=max(omega))
    if settings.task == "identify":
        return Finding(row=row, points=points_to_json(points))
    analysis = analyse(points, settings.design, fit=measured.fit, facts=measured.facts, compare=False)
    return Finding(
        row=_add_design(row, analysis, present, settings), points=points_to_json(points), result=analysis_json(analysis)
    )


def _units(loop: LoopSettings, piece: Recording) -> dict[str, str]:
    """Return the units that a loop states; those of its file where it states none and scales nothing."""
    of_file = piece.metadata.get("units", {})
    stated = {"u": (loop.u_unit, loop.u_scale), "y": (loop.y_unit, loop.y_scale)}
    return {name: unit or (of_file.get(name, "") if scale == 1.0 else "") for name, (unit, scale) in stated.items()}


def _present(loop: LoopSettings) -> Controller | None:
    if loop.controller:
        return read_controller(loop.controller)
    return PIDController(K=loop.K, Ti_s=loop.Ti_s) if loop.K is not None and loop.Ti_s is not None else None


def _with_notes(row: Row, notes: Sequence[str]) -> Row:
    return replace(row, notes="; ".join([*([row.notes] if row.notes else []), *notes]))


def _points(
    record: Record, settings: CampaignSettings, present: Controller | None
) -> tuple[tuple[FrequencyPoint, ...], PlantFit | None, tuple[str, ...]]:
    """Return the points of all pieces together and a loop's plant; what tells nothing is a note beside others."""
    if settings.method == "closed-loop":
        longest = max(record.pieces, key=len)
        require_answer([longest])
        found = identify_closed_loop(longest, controller=present)
        if not found.design_points:
            raise IdentificationError(
                found.excitation.sentence, where=longest.name, remedy="move the set-point, or dither"
            )
        return found.design_points, loop_plant(found.structures), found.warnings
    estimates, refusals = [], []
    for piece in record.pieces:
        try:
            estimates.append(_estimate_points(piece))
        except IdentificationError as error:
            refusals.append(error)
    if not estimates:
        raise refusals[0]
    combined = combine(estimates)
    if not refusals:
        return combined.points, None, combined.notes
    left_out = f"{len(refusals)} of {len(record.pieces)} pieces gave no points, the first: {refusals[0]}"
    return combined.points, None, (*combined.notes, left_out)


def _estimate_points(piece: Recording) -> FrequencyEstimate:
    """Estimate points, but not from a loop that nothing but its own feedback moved: they would lie at -1/C."""
    estimate = frequency_points(piece)
    r = piece.extra.get("r")
    if r is not None and np.isfinite(r).all() and is_constant(r) and estimate.excitation != "relay":
        raise IdentificationError(
            "the set-point never moves, so that the command may follow the feedback alone",
            where=piece.name,
            remedy='take an interval with set-point steps or method = "closed-loop"; no r where the loop was open',
        )
    return estimate


def _add_design(row: Row, analysis: Analysis, present: Controller | None, settings: CampaignSettings) -> Row:
    reduced, c, m = analysis.reduced, analysis.controller, analysis.margins
    row = replace(
        _with_notes(row, analysis.warnings),
        G_r=None if reduced is None else reduced.G_r,
        omega_0r_rad_s=None if reduced is None else reduced.omega_0r_rad_s,
        omega_d_rad_s=None if reduced is None else reduced.omega_d_rad_s,
        K=c.K,
        Ti_s=c.Ti_s,
        Td_s=c.Td_s,
        Tf_s=c.Tf_s,
        h2=m.h2,
        modulus=m.modulus,
        phase_deg=math.degrees(m.phase_rad),
        delay_margin_s=m.delay_s,
        **plant_figures(analysis.fit.plant),
    )
    if present is not None:
        return _judge_present(row, present, margins(analysis.fit.plant, present), settings)
    return replace(row, attention="designed")


def _judge_present(row: Row, present: Controller, m: Margins, settings: CampaignSettings) -> Row:
    """Judge the controller that the loop runs with by the margins that were asked for, and beside the new one."""
    asked_modulus, asked_phase = settings.design.margins
    row = replace(
        row,
        K_now=present.K if isinstance(present, PIDController) else None,
        Ti_now_s=present.Ti_s if isinstance(present, PIDController) else None,
        h2_now=m.h2,
        modulus_now=m.modulus,
        phase_now_deg=math.degrees(m.phase_rad),
        stable_now=m.stable,
    )
    if not m.stable:
        return replace(row, attention="act", severity=1.0, reason="unstable with its present controller")
    missed = 1.0 - min(m.modulus / asked_modulus, m.phase_rad / asked_phase)
    if missed > _TOLERANCE:
        reason = f"margin {100.0 * min(missed, 1.0):.0f} % too small"
        return replace(row, attention="act", severity=min(missed, 1.0), reason=reason)
    if row.h2 is not None and m.h2 > _SLUGGISH * row.h2:
        better = m.h2 / row.h2
        reason = f"disturbances could move y {better:.1f} times less"
        return replace(row, attention="look", severity=1.0 - 1.0 / better, reason=reason)
    return row


def _add_diagnosis(row: Row, found: Diagnosis) -> Row:
    attention: dict[str, Attention] = {"none": "fine", "parameters": "look", "effect": "act", "unexplained": "act"}
    fit = found.fit
    grave = attention[found.verdict] == "act"
    return replace(
        row,
        attention=attention[found.verdict],
        severity=float(np.clip(1.0 - fit.noise_floor / fit.nominal, 0.0, 1.0)) if grave and fit.nominal > 0 else 0.0,
        reason="" if found.verdict == "none" else found.sentences[0],
        verdict=found.verdict,
        effects=", ".join(f"{effect.name} ({effect.probability:.2f})" for effect in found.effects),
        nominal=fit.nominal,
        retuned=fit.retuned,
        extended=fit.extended,
        noise_floor=fit.noise_floor,
    )
