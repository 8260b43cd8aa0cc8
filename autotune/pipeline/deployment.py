"""Gains into a rig's own controller, and the old ones back where that fails: every step on disk before it is taken."""

from __future__ import annotations

import json
import os
from pathlib import Path

from autotune.controller import PIDController
from autotune.errors import AutotuneError
from autotune.experiment.rig import HoldsGains
from autotune.run_log import jsonable


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
