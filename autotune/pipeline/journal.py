"""What a hand-over is about to do to a rig's gains, on disk before it is done: the way back for a killed process."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

from autotune.controller import PIDController, read_noted_gains
from autotune.errors import ExperimentStopped, InputError
from autotune.pipeline.audit import AuditLog
from autotune.text_files import read_text
from autotune.whole_files import jsonable


class Step(StrEnum):
    """What a line of the journal says of its gains."""

    READ = "read"
    WRITING = "writing"
    WRITTEN = "written and read back"
    ON_TRIAL = "written and read back, on trial"
    KEPT = "verified, kept"
    REFUSED = "not accepted, the old gains stay"
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

        Parameters
        ----------
        step : Step
            What is about to be done, or was.
        controller : PIDController
            Whose gains it is about.
        why : str
            For the audit log.

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
        return read_noted_gains(gains, str(self.path))

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
