"""``result.json`` of a run: every part that was reached, the others null."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotune.controller import write_controller
from autotune.design.nugap import Validation
from autotune.pipeline.analysis import Analysis
from autotune.pipeline.folder import CONTROLLER
from autotune.points import points_to_json
from autotune.whole_files import jsonable, write_json

if TYPE_CHECKING:  # a recording is tuned without a rig and without a diagnosis
    from autotune.diagnosis.result import Diagnosis
    from autotune.experiment.judgement import Verification
    from autotune.experiment.result import ExperimentResult
    from autotune.experiment.running_law import RunningLaw
    from autotune.pipeline.deployment import Deployment


def write_result(
    path: Path,
    experiment: ExperimentResult | None,
    analysis: Analysis | None,
    verification: Verification | None,
    *,
    reason: str,
) -> None:
    """Write ``result.json``, every part that was reached, the others null, and beside it the file of the controller.

    Parameters
    ----------
    path : Path
        The file.
    experiment : ExperimentResult or None
        The points.
    analysis : Analysis or None
        Model, controller and margins.
    verification : Verification or None
        The loop under test.
    reason : str
        Why the run ended as it did.
    """
    content: dict[str, Any] = {
        "points": points_to_json(experiment.points) if experiment else [],
        "reduced_model": None,
        "controller": None,
        "margins": None,
        "validation": None,
        "verification": None,
        "experiment": _experiment_json(experiment, reason),
    }
    if analysis is not None:
        content |= analysis_json(analysis)
        write_controller(analysis.controller, path.with_name(CONTROLLER))
    if verification is not None:
        content["verification"] = verification_json(verification)
    write_json(path, jsonable(content))


def append_diagnosis(path: Path, found: Diagnosis) -> None:
    """Add to a ``result.json`` what a diagnosis of the run's recordings found.

    Parameters
    ----------
    path : Path
        The file, which is there.
    found : Diagnosis
        What is added.
    """
    said = found.as_json()
    content = json.loads(path.read_text(encoding="utf-8"))
    content["diagnosis"] = {key: said[key] for key in ("verdict", "effects", "places", "next_experiment")}
    write_json(path, jsonable(content))


def analysis_json(analysis: Analysis) -> dict[str, Any]:
    """Return the parts of ``result.json`` that follow from the points."""
    reduced, scaled, unscaled = analysis.reduced, analysis.scaled, analysis.unscaled
    return {
        "points": points_to_json(analysis.points),
        "fitted_plant": asdict(analysis.fit.plant),
        "reduced_model": None
        if reduced is None
        else {
            "kind": "integrating" if reduced.integrating else "self-regulating",
            "G_r": reduced.G_r,
            "omega_0r_rad_s": reduced.omega_0r_rad_s,
            "omega_d_rad_s": reduced.omega_d_rad_s,
            "relative_sd": list(reduced.sd),
            "conditions": reduced.conditions,
            "evidence": reduced.evidence,
        },
        "controller": analysis.design.to_json(),
        "designed_on": analysis.source,
        "margins": analysis.margins.to_json(),
        "noise_gain": {"at_most": analysis.design.specification.noise_gain, "from": analysis.noise_source},
        "checks": [check.to_json() for check in analysis.checks],
        "validation": None
        if scaled is None or unscaled is None
        else _validation_json(scaled) | {"unscaled": _validation_json(unscaled)},
    }


def _validation_json(validation: Validation) -> dict[str, Any]:
    return {
        "nu_gap": validation.nu_gap,
        "b_reduced": validation.b_reduced,
        "b_rig": validation.b_rig,
        "scaling": validation.scaling,
        "holds": validation.holds,
    }


def _experiment_json(experiment: ExperimentResult | None, reason: str) -> dict[str, Any]:
    if experiment is None:
        return {"rig_time_s": None, "reason": reason, "warnings": []}
    return {
        "rig_time_s": experiment.rig_time_s,
        "sweep_time_s": experiment.sweep_time_s,
        "parts": [asdict(part) for part in experiment.parts],
        "reason": reason,
        "output": experiment.output,
        "warnings": list(experiment.warnings),
        "u_rest": experiment.u_rest,
        "u_rest_sd": experiment.u_rest_sd,
        "noise_sd": experiment.noise_sd,
        "plant_sign": experiment.plant_sign,
        "timing": asdict(experiment.timing),
        "together": None if experiment.together is None else experiment.together.to_json(),
        "by_itself": experiment.by_itself,
    }


def verification_json(verification: Verification) -> dict[str, Any]:
    """Return the decision with what was predicted and what was measured."""
    return {
        "accepted": verification.accepted,
        "reason": verification.reason,
        "law": verification.by,
        "verified": verification.whose,
        "running_law": _running_law_json(verification.running_law),
        "predicted": asdict(verification.predicted) | {"rms_error_allowed": verification.allowed},
        "measured": asdict(verification.measured) | {"rms_error": verification.rms_error},
    }


def deployment_json(done: Deployment) -> dict[str, Any]:
    """Return the gains before and after a hand-over, with what was seen of the new ones."""
    seen = done.verification
    return {
        "old": asdict(done.old),
        "new": asdict(done.new),
        "kept": done.kept,
        "verified": seen.whose if seen is not None else "not verified",
        "verification": verification_json(seen) if seen is not None else None,
    }


def _running_law_json(law: RunningLaw | None) -> dict[str, Any] | None:
    if law is None:
        return None
    return {
        "is_given": law.is_given,
        "said": law.sentence,
        "misreading": law.misreading,
        "K": law.K,
        "Ti_s": law.Ti_s,
        "Td_s": law.Td_s,
        "departure": law.departure,
    }
