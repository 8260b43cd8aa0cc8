"""From a rig to a verified controller in it: the stages called in order, files into one folder."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from autotune.config import Config
from autotune.controller import PIDController
from autotune.errors import AutotuneError, ExperimentStopped, OperatorStop
from autotune.experiment.cycles import Earlier
from autotune.experiment.judgement import Verification
from autotune.experiment.result import ExperimentResult, State, Status
from autotune.experiment.rig import HoldsGains, Rig, RunsOwnController, TrialGains
from autotune.experiment.run import OnStatus, run_experiment
from autotune.experiment.sweep import missing_phases
from autotune.experiment.verify import run_verification
from autotune.outputs import unwritable
from autotune.pipeline.analysis import Analysis
from autotune.pipeline.audit import audit_log
from autotune.pipeline.deployment import deploy as deploy_and_try
from autotune.pipeline.deployment import hand_over, restore_interrupted
from autotune.pipeline.folder import (
    JOURNAL,
    PROGRESS,
    RECORDING,
    RESULT,
    VERIFICATION,
    next_free,
    read_interrupted,
    store_config,
)
from autotune.pipeline.held_gains import on_registers, round_to_rig
from autotune.pipeline.result import write_result
from autotune.pipeline.swept import analyse_sweep, facts_of, price_of
from autotune.run_log import RunLog

#: how long an operator may ask for the old gains after new ones were handed over [s]; then the new ones stay
DECISION_S = 60.0


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


def tune(
    rig: Rig,
    config: Config,
    out: Path,
    *,
    verify: bool = True,
    deploy: bool = True,
    resume: bool = False,
    on_status: OnStatus | None = None,
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
        Whether to try the new loop on the rig, and to write the gains into the rig's own controller once accepted;
        not where ``[approval]`` asks for a second person.
    resume : bool
        Whether to go on with what an interrupted run left in ``out``: only the points that are missing are measured.
    on_status : callable, optional
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
    InputError
        There is nothing to resume, or not with this configuration; nothing was done.
    ExperimentStopped, LinkError, OperatorStop
        The rig was left safe; what was recorded and the result so far are in ``out``.
    InputError
        The rig's registers are too coarse for the gains; the points are in ``out``.
    IdentificationError, DesignError
        The points give no model or no controller; they are in ``out``.
    """
    deploy = deploy and config.approval is None  # a second person does it with autotune deploy
    earlier = read_interrupted(out, config) if resume else Earlier()
    try:
        store_config(config, out)
        log_of_run = RunLog(out / PROGRESS)
    except OSError as error:
        raise unwritable(error, out) from None
    with log_of_run as log:
        log.begin(config)
        return _tune(
            rig, config, out, earlier, log, verify=verify, deploy=deploy, on_status=log.also(on_status), keep=keep
        )


def _tune(
    rig: Rig,
    config: Config,
    out: Path,
    earlier: Earlier,
    log: RunLog,
    *,
    verify: bool,
    deploy: bool,
    on_status: OnStatus,
    keep: Callable[[float], bool] | None,
) -> Tuning:
    experiment: ExperimentResult | None = None
    analysis: Analysis | None = None
    try:
        recording = next_free(out / RECORDING, ".toml")
        if missing_phases(config.experiment, earlier):
            log.recording(recording)
        experiment = run_experiment(
            rig, config, recording, earlier=earlier, on_status=on_status, price=price_of(config)
        )
        analysis = analyse_sweep(
            experiment,
            config.design,
            facts_of(config, experiment.noise_sd),
            out,
            _teller(on_status, experiment.rig_time_s),
        )
        if deploy:  # what the rig can hold is what is verified, reported and handed over
            held = round_to_rig(rig, analysis.controller, config.design, fit=analysis.fit)
            analysis = on_registers(analysis, held)
        reduced = None if analysis.reduced is None else analysis.reduced.transfer_function()
        log.say_analysis(analysis.points, analysis.fit.plant, reduced, analysis.controller)
        verification, old, deployed = _hand_over(
            rig, config, analysis, experiment, out, log, verify=verify, deploy=deploy, on_status=on_status
        )
        audit = audit_log(config, out, "run")
        log.gains(old, analysis.controller, deployed=deployed)
        if isinstance(rig, HoldsGains) and old is not None and deployed and keep is not None:
            log.waiting(DECISION_S)
            if not keep(DECISION_S):
                hand_over(rig, old, out / JOURNAL, audit=audit, why="the operator asked for the old gains")
                deployed = False
            log.gains(old, analysis.controller, deployed=deployed)
    except AutotuneError as error:
        if isinstance(error, OperatorStop):
            error.remedy = f"autotune run --resume {out} goes on with what is missing"
        with contextlib.suppress(OSError):  # a full disk must not hide why the run ended
            write_result(out / RESULT, experiment, analysis, None, reason=str(error))
        raise
    tuning = Tuning(
        experiment=experiment, analysis=analysis, verification=verification, old_controller=old, deployed=deployed
    )
    _write_completed(tuning, out)
    return tuning


def _write_completed(tuning: Tuning, out: Path) -> None:
    try:
        write_result(out / RESULT, tuning.experiment, tuning.analysis, tuning.verification, reason="completed")
    except OSError as error:
        refused, gains = unwritable(error, out / RESULT), "new" if tuning.deployed else "old"
        raise ExperimentStopped(
            f"{refused.what}; the run is complete and the rig's controller holds the {gains} gains",
            where=refused.where,
            remedy=f"free space, then autotune run --resume {out}",
        ) from None


def _hand_over(
    rig: Rig,
    config: Config,
    analysis: Analysis,
    experiment: ExperimentResult,
    out: Path,
    log: RunLog,
    *,
    verify: bool,
    deploy: bool,
    on_status: OnStatus,
) -> tuple[Verification | None, PIDController | None, bool]:
    """Verify the controller and hand it over; where the rig's own law can be tried it is what is verified.

    Returned are the verification, the gains that the rig held before, and whether it holds the new ones.
    """
    audit = audit_log(config, out, "run")

    def verified(controller: PIDController, gains: TrialGains | None = None) -> Verification:
        found = run_verification(
            rig,
            config,
            controller,
            analysis.fit,
            log.recording(next_free(out / VERIFICATION, ".toml")),
            u_rest=experiment.u_rest,
            noise_sd=experiment.noise_sd,
            gains=gains,
            on_status=on_status,
        )
        log.say_verification(found)
        return found

    if verify and deploy and isinstance(rig, RunsOwnController) and not rig.not_startable:
        restore_interrupted(rig, out / JOURNAL, audit=audit)
        done = deploy_and_try(
            rig,
            analysis.controller,
            out / JOURNAL,
            agree=lambda old, new: None,
            try_out=verified,
            audit=audit,
        )
        return done.verification, done.old, done.kept
    verification = verified(analysis.controller) if verify else None
    accepted = verification is not None and verification.accepted
    if not isinstance(rig, HoldsGains):
        return verification, None, False
    said = f"{verification.whose}; {verification.reason}" if verification is not None else ""
    old = hand_over(rig, analysis.controller if accepted and deploy else None, out / JOURNAL, audit=audit, why=said)
    return verification, old, accepted and deploy


def _teller(on_status: OnStatus, elapsed_s: float) -> Callable[[str], None]:
    """Return what says a sentence where the rig is done with and the design is not."""

    def tell(message: str) -> None:
        on_status(Status(state=State.HAND_BACK, elapsed_s=elapsed_s, remaining_s=math.nan, message=message))

    return tell
