"""The end of a session: who has the actuator afterwards. What the rig raises here is written down, not raised."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

from autotune.errors import AutotuneError, LinkError, NotTaken, OperatorStop
from autotune.experiment.rig import HandsBack, Rig, RunsOwnController

SAFE = "safe output"
NOT_TAKEN = "not taken: nothing was written to the rig"
UNSAFE = "not confirmed: the link failed, the device's own dead-man timer has to act"
#: what the one line says where the rig did not confirm
GO_TO_THE_RIG = "Go to the rig: its safe output was not confirmed"


@dataclass(frozen=True, kw_only=True)
class Farewell:
    """How a rig was left.

    Attributes
    ----------
    output : str
        Who moves the actuator now, for the sidecar and the result.
    note : str
        What the operator has to be told; empty where the rig is as it should be.
    error : str
        What the rig raised on the way out; empty where it raised nothing.
    is_confirmed : bool
        Whether the rig has confirmed it.
    """

    output: str
    note: str = ""
    error: str = ""
    is_confirmed: bool = True


def leave(rig: Rig, error: BaseException | None, restore: Callable[[], None] | None = None) -> Farewell:
    """Make the rig safe or give it back to its own controller, close it, and say how it was left; raises nothing.

    Parameters
    ----------
    rig : Rig
        In any state.
    error : BaseException or None
        What ended the session. Where it came to its end, or the operator ended it, a controller that ran before gets
        the actuator back; after a limit or a fault the rig is made safe and the controller is left to a person.
    restore : callable, optional
        Puts back what the session changed in the rig's own controller: under the host's command before that controller
        gets the actuator, or once the rig is safe. Whoever gives it looks whether it has been done.
    """
    farewell = _leave(rig, error, restore)
    with contextlib.suppress(Exception):  # a driver may raise what it likes here: the rig is left already
        rig.close()
    return farewell


def _leave(rig: Rig, error: BaseException | None, restore: Callable[[], None] | None) -> Farewell:
    if isinstance(error, NotTaken):
        return Farewell(output=NOT_TAKEN)
    former = rig.former if isinstance(rig, HandsBack) else None
    failed = ""
    if former is not None and isinstance(rig, HandsBack) and _is_orderly(error):
        try:
            if restore is not None:
                if isinstance(rig, RunsOwnController):
                    rig.take_command()
                restore()
            rig.hand_back()
        except Exception as cause:
            failed = _words(cause)
        else:
            return Farewell(output=f"handed back to its own controller: {former}")
    try:
        rig.make_safe()
    except Exception as cause:
        return Farewell(output=UNSAFE, note=GO_TO_THE_RIG, error=_words(cause), is_confirmed=False)
    if restore is not None:
        with contextlib.suppress(Exception):
            restore()
    if former is None:
        return Farewell(output=SAFE)
    note = f"its own controller was in {former} before and was not restored: give it the actuator back at the rig"
    return Farewell(output=SAFE, note=note, error=failed)


def sentence(output: str) -> str:
    """Return what a page says of how a rig was left, from the sidecar's ``output``; empty of a killed process."""
    match output:
        case "":
            return "its safe output is unknown: the device's own dead-man timer has to act. Go to the rig"
        case x if x == SAFE:
            return "the rig has its safe output"
        case x if x == UNSAFE:
            return GO_TO_THE_RIG
    return f"the rig was {output}"


def _is_orderly(error: BaseException | None) -> bool:
    return error is None or isinstance(error, OperatorStop | KeyboardInterrupt)


def _words(error: Exception) -> str:
    return str(error) if isinstance(error, AutotuneError) else f"{type(error).__name__}: {error}"


def verdict_on(error: BaseException | None) -> AutotuneError | None:
    """Return the verdict that an error of another kind stands for; None where it is a verdict already, or a defect."""
    if isinstance(error, KeyboardInterrupt):  # one that no handler of ours caught (not the main thread)
        return OperatorStop("stopped by Ctrl-C", remedy="run it again when ready")
    if isinstance(error, OSError) and not isinstance(error, AutotuneError):  # of a driver that does not name its own
        return LinkError(f"the link failed ({error.strerror or error})", remedy="check cable and power of the device")
    return None


def say(error: BaseException, note: str) -> None:
    """Have the error's one line say how the rig was left.

    Parameters
    ----------
    error : BaseException
        The error, changed in place.
    note : str
        How the rig was left; nothing is changed where it is empty.
    """
    if not note:
        return
    if isinstance(error, AutotuneError):
        error.what = f"{error.what}. {note[0].upper()}{note[1:]}"
    else:
        error.add_note(note)
