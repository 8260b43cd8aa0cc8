"""Gains into a rig's own controller, and the old ones back where that fails: every step on disk before it is taken."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, NoReturn

from autotune.config.procedure import DesignSettings
from autotune.controller import PIDController, held_from_table
from autotune.errors import AutotuneError, ExperimentStopped, InputError, LinkError, OperatorStop
from autotune.experiment.judgement import Verification
from autotune.experiment.rig import HoldsGains
from autotune.interrupts import interrupt_deferred
from autotune.pipeline.audit import AuditLog
from autotune.pipeline.held_gains import held_by
from autotune.run_log import jsonable
from autotune.text_files import read_text


class Step(StrEnum):
    """What a line of the journal says of its gains."""

    READ = "read"
    WRITING = "writing"
    WRITTEN = "written and read back"
    ON_TRIAL = "written and read back, on trial"
    KEPT = "verified, kept"
    HOST_ONLY = "host's law verified; the device's own law not tried"
    RESTORING = "restoring"
    RESTORED = "restored"


#: last steps after which the rig's gains are new ones unverified, or unknown
OPEN_ENDS = (Step.WRITING, Step.ON_TRIAL, Step.RESTORING)


class Journal:
    """``journal.jsonl``: one JSON object per step, with its gains and its time, appended before the step is taken.

    Parameters
    ----------
    path : Path
        File to append to; made by the first note.
    audit : AuditLog, optional
        Gets a line for every step that changes the rig's gains.
    """

    def __init__(self, path: Path, audit: AuditLog | None = None) -> None:
        self.path = path
        self.audit = audit
        self._old: PIDController | None = None

    def note(self, step: Step, controller: PIDController, why: str = "") -> None:
        """Append a step and bring it to the disk; in the audit log with why it is taken.

        Raises
        ------
        ExperimentStopped
            The file cannot be written.
        """
        where = self.path
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps(jsonable({"gains": step.value, "at": at, **asdict(controller)}))
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
                file.flush()
                os.fsync(file.fileno())
            if step is Step.READ:
                self._old = controller
            elif self.audit is not None:
                where = self.audit.path
                self.audit.note(step.value, old=self._old or controller, new=controller, why=why)
        except OSError as error:
            raise ExperimentStopped(
                f"the journal cannot be written ({error.strerror})",
                where=str(where),
                remedy="free space on the disk; no gains are written that are not in it first",
            ) from error

    def unfinished(self) -> PIDController | None:
        """Return the gains to go back to where the last hand-over was interrupted, None where it was not.

        Raises
        ------
        InputError
            The file is not a journal, or the gains in it are no finite numbers.
        """
        if not self.path.exists():
            return None
        notes = self._notes()
        if not notes or notes[-1][0] not in OPEN_ENDS:
            return None
        gains = next((gains for step, gains in reversed(notes) if step is Step.READ), None)
        if gains is None:
            raise self._no_journal("its end is open and no gains were read before")
        return held_from_table(gains, str(self.path))

    def _notes(self) -> list[tuple[Step, dict[str, Any]]]:
        """Return the steps with their gains; a line without its end was cut off before its step was taken."""
        text = read_text(self.path)
        notes = []
        for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
            try:
                note = json.loads(line)
                note.pop("at", None)
                notes.append((Step(note.pop("gains")), note))
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
                raise self._no_journal(f"line {number} says no step") from None
        return notes

    def _no_journal(self, why: str) -> InputError:
        return InputError(
            f"not a journal of gains: {why}", where=str(self.path), remedy="move it away, and check the rig's gains"
        )


@dataclass(frozen=True, kw_only=True)
class Deployment:
    """What became of a hand-over.

    Attributes
    ----------
    old, new : PIDController
        Gains the rig held before, and those that were handed to it, as it read them back.
    verification : Verification or None
        The loop with the new gains; None where it was not asked for.
    """

    old: PIDController
    new: PIDController
    verification: Verification | None

    @property
    def kept(self) -> bool:
        """Whether the rig holds the new gains."""
        return self.verification is None or self.verification.accepted


def read_gains(rig: HoldsGains) -> PIDController:
    """Return the gains that the rig's own controller holds; the actuator is left to whoever has it."""
    try:
        return rig.read_gains()
    finally:
        rig.close()


def hand_over(
    rig: HoldsGains,
    controller: PIDController | None,
    journal: Path,
    *,
    audit: AuditLog | None = None,
    why: str = "",
) -> PIDController:
    """Write verified gains into the rig's own controller, and the old ones back if that fails halfway.

    Where the journal says that an earlier hand-over was interrupted, the gains from before it are restored first.

    Parameters
    ----------
    rig : HoldsGains
        Closed; it is connected to for this, and its actuator left to whoever has it.
    controller : PIDController or None
        New gains; None only reads the old ones.
    journal : Path
        File that says what is about to be written before it is, so that a killed process leaves no riddle.
    audit : AuditLog, optional
        Gets a line for every change of the rig's gains.
    why : str
        Of the new gains, for the audit log.

    Returns
    -------
    PIDController
        The gains the rig held before.

    Raises
    ------
    LinkError, ExperimentStopped, OperatorStop
        The new gains could not be written and read back, the journal could not be written, Ctrl-C came between; the
        message says whether the old ones are in place again.
    """
    notes = Journal(journal, audit)
    restore_interrupted(rig, journal, audit=audit)
    old = read_gains(rig)
    notes.note(Step.READ, old)
    if controller is not None:
        _write(rig, controller, old, notes, Step.WRITTEN, why)
    return old


def restore_interrupted(rig: HoldsGains, journal: Path, *, audit: AuditLog | None = None) -> None:
    """Write the gains back that the rig held before a hand-over that did not come to its end, where there was one."""
    before = Journal(journal).unfinished()
    if before is not None:
        restore(rig, before, journal, audit=audit, why="an earlier hand-over was interrupted")


def deploy(
    rig: HoldsGains,
    controller: PIDController,
    journal: Path,
    *,
    agree: Callable[[PIDController, PIDController], None],
    try_out: Callable[[PIDController], Verification] | None,
    audit: AuditLog | None = None,
) -> Deployment:
    """Hand new gains to the rig's own controller, try them, and take them back unless they behave as predicted.

    Parameters
    ----------
    rig : HoldsGains
        Closed; it is connected to for every step, and only the trial takes its actuator.
    controller : PIDController
        New gains.
    journal : Path
        File that says what is about to be done before it is.
    agree : callable
        Shown the old and the new gains before anything is written; raises where they are refused.
    try_out : callable or None
        Runs the verification with the gains as the rig read them back; None keeps them without.
    audit : AuditLog, optional
        Gets a line for every change of the rig's gains.

    Raises
    ------
    LinkError, ExperimentStopped, OperatorStop
        Writing or verification was broken off; the message says whether the old gains are in place again.
    """
    notes = Journal(journal, audit)
    old = read_gains(rig)
    agree(old, controller)
    notes.note(Step.READ, old)
    held = _write(rig, controller, old, notes, Step.ON_TRIAL if try_out else Step.WRITTEN)
    if try_out is None:
        return Deployment(old=old, new=held, verification=None)
    try:
        verification = try_out(held)
        if verification.accepted:
            _require_held(rig, held)
    except BaseException as error:
        _take_back(rig, old, notes, error, "the verification was broken off")
    if verification.accepted:
        step = Step.KEPT if verification.by == "device" else Step.HOST_ONLY
        notes.note(step, held, f"{verification.whose}; {verification.reason}")
    else:
        restore(rig, old, journal, audit=audit, why=verification.reason)
    return Deployment(old=old, new=held, verification=verification)


def _require_held(rig: HoldsGains, tried: PIDController) -> None:
    """Refuse to keep gains that are not those which were on trial."""
    held = read_gains(rig)
    if held != tried:
        raise LinkError(
            f"the rig holds K = {held.K:.4g}, T_I = {held.Ti_s:.4g} s after the trial"
            f" where K = {tried.K:.4g}, T_I = {tried.Ti_s:.4g} s were tried: another master writes its gains",
            where="hand-over of the gains",
            remedy="end the other session; only one master may command",
        )


def restore(
    rig: HoldsGains, old: PIDController, journal: Path, *, audit: AuditLog | None = None, why: str = ""
) -> None:
    """Write the old gains back.

    Parameters
    ----------
    rig : HoldsGains
        Closed; it is connected to for this, and its actuator left to whoever has it.
    old : PIDController
        Gains to go back to.
    journal : Path
        The journal of the hand-over; it stays open-ended where this fails.
    audit : AuditLog, optional
        Gets a line before and after.
    why : str
        For the audit log.

    Raises
    ------
    LinkError
        They could not be written and read back.
    """
    notes = Journal(journal, audit)
    # a full disk must not keep new gains: the journal is open-ended already, and stays so where the end is missing
    with contextlib.suppress(ExperimentStopped):
        notes.note(Step.RESTORING, old, why)
    try:
        rig.write_gains(old)
    finally:
        rig.close()
    with contextlib.suppress(ExperimentStopped):
        notes.note(Step.RESTORED, old, why)


def _write(
    rig: HoldsGains, new: PIDController, old: PIDController, notes: Journal, done: Step, why: str = ""
) -> PIDController:
    """Write the new gains, or the old ones where that fails; return the new ones as the rig holds them.

    Raises
    ------
    InputError
        The rig's registers cannot hold them, or only far from what they are; nothing was written.
    """
    new = held_by(rig, new, DesignSettings())
    notes.note(Step.WRITING, new, why)
    try:
        try:
            rig.write_gains(new)
            held = rig.read_gains()
        finally:
            rig.close()
        notes.note(done, held, why)
    except BaseException as error:
        _take_back(rig, old, notes, error, "the hand-over was broken off")
    return held


def _take_back(rig: HoldsGains, old: PIDController, notes: Journal, error: BaseException, what: str) -> NoReturn:
    """Restore the old gains after whatever ended a hand-over, and raise one of its kind that says what they are now.

    A second Ctrl-C waits until they are in place.
    """
    try:
        with interrupt_deferred():
            restore(rig, old, notes.path, audit=notes.audit, why=what)
        state, remedy = "the old gains are in place again", "check the link and the rig, and deploy again"
    except KeyboardInterrupt:  # the one that waited
        state, remedy = "the old gains are in place again", "deploy again when ready"
    except AutotuneError as second:
        state = f"the old gains could not be written back ({second.what}): the rig may hold old, new or mixed gains"
        remedy = "stop it; once the link is back, autotune deploy offers to restore them"
    where = "hand-over of the gains"
    if isinstance(error, AutotuneError):
        raise type(error)(f"{what} ({error.what}); {state}", where=where, remedy=remedy) from error
    if isinstance(error, KeyboardInterrupt):
        raise OperatorStop(f"stopped by Ctrl-C: {what}; {state}", where=where, remedy=remedy) from error
    error.add_note(f"{what}; {state}")
    raise error
