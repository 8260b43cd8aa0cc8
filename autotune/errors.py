"""Failures as named verdicts: what happened, where, and the remedy.

Every error of the tool says these three things in one line; the command line prints that line and leaves with the
exit status of the error's class (0 done, 2 input refused, 3 experiment stopped and rig safe, 130 stopped by the
operator).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import partial
from typing import ClassVar


class AutotuneError(Exception):
    """Base of every error this project raises on purpose.

    Parameters
    ----------
    what : str
        What happened, in the reader's terms.
    where : str
        File, key, row, register or state it happened at.
    remedy : str
        What the reader can do about it.
    """

    exit_status: ClassVar[int] = 1

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        super().__init__(what, where, remedy)
        self.what = what
        self.where = where
        self.remedy = remedy

    def __reduce__(self) -> tuple[Callable[[str], AutotuneError], tuple[str]]:
        """Return what makes it again in another process."""
        return partial(type(self), where=self.where, remedy=self.remedy), (self.what,)

    def __str__(self) -> str:
        head = f"{self.where}: {self.what}" if self.where else self.what
        return f"{head}; {self.remedy}" if self.remedy else head


class InputError(AutotuneError, ValueError):
    """A file, a setting or an argument was refused; nothing was done."""

    exit_status = 2


def require_extra(extra: str, *packages: str) -> None:
    """Refuse where the packages of an extra are not installed.

    Parameters
    ----------
    extra : str
        As in ``pip install 'relay-autotune[extra]'``.
    packages : str
        What is imported of it.

    Raises
    ------
    InputError
        With the command that installs it.
    """
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    if missing:
        remedy = f"pip install 'relay-autotune[{extra}]'"
        raise InputError(f"{' and '.join(missing)} not installed", where=f"this needs the extra {extra}", remedy=remedy)


class IdentificationError(InputError):
    """The data do not determine what was asked for; the message names the reason and the experiment that would."""


class DesignError(InputError):
    """No controller meets the specification; the message names the nearest reachable one."""


class ExperimentStopped(AutotuneError, RuntimeError):  # noqa: N818 - a verdict, not a defect
    """A limit or a fault ended the experiment; the rig was left at its safe output and the recording kept."""

    exit_status = 3


class LinkError(ExperimentStopped, ConnectionError):
    """The link to the rig failed, or answered something that is not a sample."""


class NotTaken(LinkError):  # noqa: N818 - a verdict, as its base
    """The rig was not taken: nothing was written to it, and it is as it was before."""


class OperatorStop(ExperimentStopped):
    """Ctrl-C or SIGTERM ended the experiment; the rig was left at its safe output."""

    exit_status = 130


class Unforeseen(AutotuneError):  # noqa: N818 - a verdict as well
    """A defect of the tool that the command line caught; its traceback is in a file."""


class UnforeseenAtRig(ExperimentStopped):
    """A defect of the tool while it had a rig in command; every exit of the control loop makes the rig safe."""
