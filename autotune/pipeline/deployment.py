"""Gains into a rig's own controller, and the old ones back where that fails: every step on disk before it is taken."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

from autotune.config.procedure import DesignSettings
from autotune.controller import PIDController
from autotune.errors import AutotuneError, ExperimentStopped, LinkError, OperatorStop
from autotune.experiment.judgement import Verification
from autotune.experiment.leaving import leave, say
from autotune.experiment.rig import HoldsGains, RoundsGains, RunsOwnController, TrialGains
from autotune.interrupts import interrupt_deferred
from autotune.pipeline.audit import AuditLog
from autotune.pipeline.held_gains import round_to_rig
from autotune.pipeline.journal import Journal, Step


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
    """Write the gains back that the rig held before a hand-over that did not come to its end, where there was one.

    Parameters
    ----------
    rig : HoldsGains
        Connected.
    journal : path
        Of hand-overs to this rig.
    audit : AuditLog, optional
        Told of it.
    """
    before = Journal(journal).unfinished()
    if before is not None:
        restore(rig, before, journal, audit=audit, why="an earlier hand-over was interrupted")


def deploy(
    rig: HoldsGains,
    controller: PIDController,
    journal: Path,
    *,
    agree: Callable[[PIDController, PIDController], None],
    try_out: Callable[[PIDController, TrialGains | None], Verification] | None,
    audit: AuditLog | None = None,
) -> Deployment:
    """Try new gains on the rig, and hand them to its own controller where the loop behaves as predicted.

    Where the host can start that controller the gains are in it for the trial, and only while the host commands or
    watches; otherwise the host's law is tried and the gains are written once it is accepted. Accepted gains are written
    while the host commands, where it can, so that no controller runs on half of them.

    Parameters
    ----------
    rig : HoldsGains
        Closed; it is connected to for every step.
    controller : PIDController
        New gains.
    journal : Path
        File that says what is about to be done before it is.
    agree : callable
        Shown the old and the new gains before anything is written; raises where they are refused.
    try_out : callable or None
        Runs the verification with the gains as the rig will hold them; given what puts them into its own controller,
        None where the host's law is tried. None writes the gains without a trial, whoever has the actuator.
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
    if try_out is None:
        held = _write(rig, controller, old, notes, Step.WRITTEN)
        return Deployment(old=old, new=held, verification=None)
    new = _as_held(rig, controller, old)
    startable = isinstance(rig, RunsOwnController) and not rig.not_startable
    trial = _Trial(rig, new, old, notes)
    try:
        verification = try_out(new, trial if startable else None)
        trial.require_over(verification)
    except BaseException as error:
        if not trial.was_written:
            raise
        trial.broken_off(error, "the verification was broken off")
    if not verification.accepted:
        with contextlib.suppress(ExperimentStopped):  # a full disk changes nothing of it
            notes.note(Step.REFUSED, new, verification.reason)
        return Deployment(old=old, new=new, verification=verification)
    step = Step.HOST_ONLY if verification.by == "host" else Step.KEPT
    why = f"{verification.whose}; {verification.reason}"
    held = trial.keep(step, why) if startable else _write(rig, new, old, notes, step, why)
    return Deployment(old=old, new=held, verification=verification)


def _as_held(rig: HoldsGains, controller: PIDController, old: PIDController) -> PIDController:
    """Return what the rig's own controller computes with the new gains: they rounded, its set-point weight its own."""
    held = round_to_rig(rig, controller, DesignSettings())
    has_weight_of_its_own = isinstance(rig, RoundsGains) and not rig.takes_weight
    return replace(held, setpoint_weight=old.setpoint_weight) if has_weight_of_its_own else held


class _Trial:
    """New gains in a rig's own controller while the host commands or watches it, and the old ones back afterwards.

    Parameters
    ----------
    rig : HoldsGains
        Its own controller.
    new, old : PIDController
        Gains.
    notes : Journal
        Takes every step before it is taken.
    """

    def __init__(self, rig: HoldsGains, new: PIDController, old: PIDController, notes: Journal) -> None:
        self._rig, self._new, self._old, self._notes = rig, new, old, notes
        self._is_in = False  # whether the rig may hold the new gains, or half of them
        self.was_written = False
        self._held = self._found = new  # right after they were put in, and before they were taken out

    def put_in(self, done: Step = Step.ON_TRIAL, why: str = "") -> None:
        """Write the new gains and read them back."""
        self._notes.note(Step.WRITING, self._new, why)
        self._is_in = self.was_written = True
        self._rig.write_gains(self._new)
        self._held = self._found = self._rig.read_gains()
        self._notes.note(done, self._held, why)

    def take_out(self) -> None:
        """Write the old gains again, where that is still to be done; look first what the rig holds."""
        if self._is_in:
            with contextlib.suppress(LinkError):
                self._found = self._rig.read_gains()
            _write_back(self._rig, self._old, self._notes, "the trial is over")
            self._is_in = False

    def require_over(self, verification: Verification) -> None:
        """Refuse to go on with a rig that still has the gains of the trial, or that had others during it."""
        if self._is_in:
            raise LinkError("the old gains were not taken", where="hand-over of the gains", remedy="check the link")
        if verification.accepted and self._found != self._held:
            raise LinkError(
                f"the rig holds K = {self._found.K:.4g}, T_I = {self._found.Ti_s:.4g} s after the trial where"
                f" K = {self._held.K:.4g}, T_I = {self._held.Ti_s:.4g} s were tried: another master writes its gains",
                where="hand-over of the gains",
                remedy="end the other session; only one master may command",
            )

    def keep(self, step: Step, why: str) -> PIDController:
        """Write the new gains for good, and return them as the rig holds them."""
        try:
            with _command(self._rig, self.take_out), interrupt_deferred():
                self.put_in(step, why)
        except BaseException as error:
            self.broken_off(error, "the hand-over was broken off")
        return self._held

    def broken_off(self, error: BaseException, what: str) -> NoReturn:
        """Have the old gains in place, and raise an error of the same kind that says so."""
        _take_back(self._rig, self._old, self._notes, error, what, is_done=not self._is_in)


@contextlib.contextmanager
def _command(rig: HoldsGains, restore: Callable[[], None]) -> Iterator[None]:
    """Have the host command meanwhile, and whoever had the actuator have it again; after an error restore first."""
    try:
        rig.open()
        yield
        rig.read()  # whether the host still commands
    except BaseException as error:
        with interrupt_deferred():
            farewell = leave(rig, error, restore)
        say(error, farewell.note)
        raise
    with interrupt_deferred():
        farewell = leave(rig, None)
    if farewell.note:
        raise LinkError(farewell.note, where="hand-over of the gains", remedy="look at the rig before anything else")


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
    try:
        _write_back(rig, old, Journal(journal, audit), why)
    finally:
        rig.close()


def _write_back(rig: HoldsGains, old: PIDController, notes: Journal, why: str) -> None:
    # a full disk must not keep new gains: the journal is open-ended already, and stays so where the end is missing
    with contextlib.suppress(ExperimentStopped):
        notes.note(Step.RESTORING, old, why)
    rig.write_gains(old)
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
    new = round_to_rig(rig, new, DesignSettings())
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


def _take_back(
    rig: HoldsGains,
    old: PIDController,
    notes: Journal,
    error: BaseException,
    what: str,
    *,
    is_done: bool = False,
) -> NoReturn:
    """Restore the old gains after whatever ended a hand-over, and raise one of its kind that says what they are now.

    A second Ctrl-C waits until they are in place.
    """
    try:
        with interrupt_deferred():
            if not is_done:
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
