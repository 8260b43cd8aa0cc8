"""From points to a checked controller, and from a rig to a verified one: the stages below, called in order."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from autotune.config import Config
from autotune.config.procedure import DesignSettings
from autotune.controller import PIDController
from autotune.design.margins import Margins, margins
from autotune.design.nugap import Validation, loop_scaling, validate
from autotune.design.robust import design_on_points
from autotune.design.specification import Design, Specification
from autotune.design.synthesis import design
from autotune.errors import AutotuneError
from autotune.experiment.result import ExperimentResult
from autotune.experiment.rig import HoldsGains, Rig
from autotune.experiment.run import OnProgress, run_experiment
from autotune.experiment.verify import Verification, run_verification
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.identification.reduction import ReducedModel, reduce_points
from autotune.points import FrequencyPoint, points_to_json
from autotune.run_log import RunLog, jsonable

RECORDING, VERIFICATION, RESULT, JOURNAL = "recording.csv", "verification.csv", "result.json", "journal.jsonl"
PROGRESS = "progress.jsonl"
#: how long an operator may ask for the old gains after new ones were handed over [s]; then the new ones stay
DECISION_S = 60.0


@dataclass(frozen=True, kw_only=True)
class Analysis:
    """What follows from the points alone, without a rig.

    Attributes
    ----------
    points : tuple of FrequencyPoint
        What was measured.
    fit : PlantFit
        Transfer function through the points, for predictions.
    reduced : ReducedModel
        Model whose margins are a guarantee.
    design : Design
        Controller, by default on the reduced model.
    alternatives : tuple of (str, Design or str)
        What other bases of the design give: the reduced model, the points, the fitted plant held for true; or why not.
    margins : Margins
        Of the controller on the fitted plant.
    unscaled, scaled : Validation
        Criterion (10) in the units of the signals, and scaled as the loop itself weighs them at its crossover.
    warnings : tuple of str
        What the reader should know.
    """

    points: tuple[FrequencyPoint, ...]
    fit: PlantFit
    reduced: ReducedModel
    design: Design
    alternatives: tuple[tuple[str, Design | str], ...]
    margins: Margins
    unscaled: Validation
    scaled: Validation
    warnings: tuple[str, ...]

    @property
    def controller(self) -> PIDController:
        """The controller."""
        return self.design.controller


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """What a whole run ends with; what was not reached is None.

    Attributes
    ----------
    experiment : ExperimentResult
        The sweep.
    analysis : Analysis
        Model and controller.
    verification : Verification or None
        The new loop on the rig; None where it was not asked for.
    old_controller : PIDController or None
        Gains the rig held before.
    deployed : bool
        Whether the rig now holds the new gains.
    """

    experiment: ExperimentResult
    analysis: Analysis
    verification: Verification | None
    old_controller: PIDController | None
    deployed: bool


def specification(settings: DesignSettings) -> Specification:
    """Return the constraints that the configuration asks for."""
    modulus, phase_rad = settings.margins
    return Specification(modulus_margin=modulus, phase_margin_rad=phase_rad, noise_gain=settings.noise_gain)


def analyse(points: Sequence[FrequencyPoint], settings: DesignSettings, *, compare: bool = True) -> Analysis:
    """Fit, reduce, design and validate.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, spanning -135 degrees.
    settings : DesignSettings
        Structure, specification, and whether to design on the reduced model or straight on the points.
    compare : bool
        Whether to design on the other bases too; the design on the points takes more than all the rest.

    Raises
    ------
    IdentificationError, DesignError
        The points do not determine a model, or no controller meets the specification.
    """
    fit = fit_plant(points)
    reduced = reduce_points(points)
    H_r = reduced.transfer_function()
    wanted, kind = specification(settings), settings.kind
    bases: dict[str, Callable[[], Design]] = {
        "reduced model": lambda: design(H_r, wanted, kind),
        "points": lambda: design_on_points(points, wanted, kind),
        "fitted plant": lambda: design(fit.plant, wanted, kind, certificate=False),
    }
    designed = bases.pop(settings.source)()
    controller = designed.controller
    achieved = margins(fit.plant, controller)
    return Analysis(
        points=tuple(sorted(points, key=lambda point: point.omega_rad_s)),
        fit=fit,
        reduced=reduced,
        design=designed,
        alternatives=tuple((name, _or_reason(make)) for name, make in bases.items()) if compare else (),
        margins=achieved,
        unscaled=validate(fit.plant, H_r, controller),
        scaled=validate(fit.plant, H_r, controller, scaling=loop_scaling(H_r, controller)),
        warnings=reduced.warnings,
    )


def _or_reason(make: Callable[[], Design]) -> Design | str:
    """Return a design for comparison, or why there is none; only the one asked for may stop a run."""
    try:
        return make()
    except AutotuneError as error:
        return str(error)


def tune(
    rig: Rig,
    config: Config,
    out: Path,
    *,
    verify: bool = True,
    deploy: bool = True,
    on_progress: OnProgress | None = None,
    keep: Callable[[float], bool] | None = None,
) -> Tuning:
    """Run the whole chain on a rig: sweep, analyse, verify, hand over the gains; files go into ``out``.

    Parameters
    ----------
    rig : Rig
        Closed.
    config : Config
        Everything else.
    out : Path
        Existing folder.
    verify, deploy : bool
        Whether to try the new loop on the rig, and to write the gains into the rig's own controller once accepted.
    on_progress : callable, optional
        Told where the procedure is.
    keep : callable, optional
        Asked once accepted gains were handed over, with the time to wait for an answer [s]; the old ones are written
        back where it says no.

    Returns
    -------
    Tuning
        With the verdict of the verification; the old gains stay unless the new ones were accepted.

    Raises
    ------
    ExperimentStopped, LinkError, OperatorStop
        The rig was left safe; what was recorded and the result so far are in ``out``.
    IdentificationError, DesignError
        The points give no model or no controller; they are in ``out``.
    """
    with RunLog(out / PROGRESS) as log:
        log.begin(config)
        return _tune(rig, config, out, log, verify=verify, deploy=deploy, on_progress=log.also(on_progress), keep=keep)


def _tune(
    rig: Rig,
    config: Config,
    out: Path,
    log: RunLog,
    *,
    verify: bool,
    deploy: bool,
    on_progress: OnProgress,
    keep: Callable[[float], bool] | None,
) -> Tuning:
    experiment: ExperimentResult | None = None
    analysis: Analysis | None = None
    try:
        experiment = run_experiment(rig, config, log.recording(out / RECORDING), on_progress=on_progress)
        analysis = analyse(experiment.points, config.design)
        plant, reduced = analysis.fit.plant, analysis.reduced.transfer_function()
        log.analysed(analysis.points, plant, reduced, analysis.controller)
        verification = None
        if verify:
            verification = run_verification(
                rig,
                config,
                analysis.controller,
                analysis.fit,
                log.recording(out / VERIFICATION),
                u_rest=experiment.u_rest,
                noise_sd=experiment.noise_sd,
                crossover_rad_s=analysis.margins.crossover_rad_s,
                on_progress=on_progress,
            )
            log.verified(verification)
        accepted = verification is not None and verification.accepted
        old, deployed = None, False
        if isinstance(rig, HoldsGains):
            old = hand_over(rig, analysis.controller if accepted and deploy else None, out / JOURNAL)
            deployed = accepted and deploy
        log.gains(old, analysis.controller, deployed=deployed)
        if isinstance(rig, HoldsGains) and old is not None and deployed and keep is not None:
            log.waiting(DECISION_S)
            if not keep(DECISION_S):
                hand_over(rig, old, out / JOURNAL)
                deployed = False
            log.gains(old, analysis.controller, deployed=deployed)
    except AutotuneError as error:
        write_result(out / RESULT, experiment, analysis, None, reason=str(error))
        raise
    write_result(out / RESULT, experiment, analysis, verification, reason="completed")
    return Tuning(
        experiment=experiment, analysis=analysis, verification=verification, old_controller=old, deployed=deployed
    )


def hand_over(rig: HoldsGains, controller: PIDController | None, journal: Path) -> PIDController:
    """Write gains into the rig's own controller, and the old ones back if that fails halfway.

    Parameters
    ----------
    rig : HoldsGains
        Closed; it is opened for this and closed again.
    controller : PIDController or None
        New gains; None only reads the old ones.
    journal : Path
        File that says what is about to be written before it is, so that a killed process leaves no riddle.

    Returns
    -------
    PIDController
        The gains the rig held before.

    Raises
    ------
    LinkError
        The new gains could not be written and read back; the message says whether the old ones are in place again.
    """
    rig.open()
    try:
        old = rig.read_gains()
        _note(journal, "read", old)
        if controller is not None:
            _note(journal, "writing", controller)
            try:
                rig.write_gains(controller)
            except AutotuneError as error:
                _note(journal, "restoring", old)
                rig.write_gains(old)
                _note(journal, "restored", old)
                raise type(error)(
                    f"the new gains could not be written ({error.what})",
                    where="hand-over of the gains",
                    mend="the old gains are in place again; check the link and deploy again",
                ) from error
            _note(journal, "written and read back", controller)
        return old
    finally:
        rig.make_safe()
        rig.close()


def _note(journal: Path, what: str, controller: PIDController) -> None:
    line = json.dumps(jsonable({"gains": what, "K": controller.K, "Ti_s": controller.Ti_s, "Td_s": controller.Td_s}))
    with journal.open("a", encoding="utf-8") as file:
        file.write(line + "\n")
        file.flush()
        os.fsync(file.fileno())


def write_result(
    path: Path,
    experiment: ExperimentResult | None,
    analysis: Analysis | None,
    verification: Verification | None,
    *,
    reason: str,
) -> None:
    """Write ``result.json``: every part that was reached, the others null."""
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
    if verification is not None:
        content["verification"] = _verification_json(verification)
    path.write_text(json.dumps(jsonable(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def analysis_json(analysis: Analysis) -> dict[str, Any]:
    """Return the parts of ``result.json`` that follow from the points."""
    reduced, scaled = analysis.reduced, analysis.scaled
    return {
        "points": points_to_json(analysis.points),
        "reduced_model": {
            "kind": "integrating" if reduced.integrating else "self-regulating",
            "G_r": reduced.G_r,
            "omega_0r_rad_s": reduced.omega_0r_rad_s,
            "omega_d_rad_s": reduced.omega_d_rad_s,
            "relative_sd": list(reduced.sd),
            "conditions": reduced.conditions,
            "evidence": reduced.evidence,
        },
        "controller": analysis.design.to_json(),
        "margins": analysis.margins.to_json(),
        "validation": _validation_json(scaled) | {"unscaled": _validation_json(analysis.unscaled)},
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
        "reason": reason,
        "warnings": list(experiment.warnings),
        "u_rest": experiment.u_rest,
        "u_rest_sd": experiment.u_rest_sd,
        "noise_sd": experiment.noise_sd,
        "plant_sign": experiment.plant_sign,
        "timing": asdict(experiment.timing),
    }


def _verification_json(verification: Verification) -> dict[str, Any]:
    return {
        "accepted": verification.accepted,
        "reason": verification.reason,
        "predicted": asdict(verification.predicted) | {"misfit_allowed": verification.allowed},
        "measured": asdict(verification.measured) | {"misfit": verification.misfit},
    }
