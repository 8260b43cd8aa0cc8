"""Who may hand gains over: a second person, by name and with a reason, where ``[approval]`` asks for one."""

from __future__ import annotations

from dataclasses import dataclass

from autotune.config import Config
from autotune.errors import InputError
from autotune.pipeline.audit import user

_REMEDY = "a second person looks at the gains and gives --approved-by NAME --reason TEXT"


@dataclass(frozen=True, kw_only=True)
class Approval:
    """A second person's word: name and reason, as they are written to the audit log."""

    name: str
    reason: str


def approval_of(config: Config, name: str | None, reason: str | None) -> Approval | None:
    """Return the approval of a hand-over; None where none was given and none is asked for.

    Parameters
    ----------
    config : Config
        Its ``[approval]`` says whether one is needed, and whose.
    name, reason : str or None
        As the second person gave them.

    Raises
    ------
    InputError
        None was given where one is needed, or half of one; the name is that of who asks, or of nobody who may approve.
    """
    name, reason = (name or "").strip(), (reason or "").strip()
    if not name and not reason and config.approval is None:
        return None
    if not name or not reason:
        raise InputError(
            f"the hand-over needs a second person's {'name' if not name else 'reason'}",
            where="approval",
            remedy=_REMEDY,
        )
    own = user().casefold().split(" as ")
    if name.casefold() in own:
        raise InputError(f"{name} asks for the hand-over and cannot approve it", where="approval", remedy=_REMEDY)
    approvers = config.approval.approvers if config.approval is not None else ()
    if approvers and name.casefold() not in [one.casefold() for one in approvers]:
        raise InputError(
            f"{name} is none of those who may approve: {', '.join(approvers)}",
            where="approval.approvers",
            remedy=_REMEDY,
        )
    return Approval(name=name, reason=reason)
