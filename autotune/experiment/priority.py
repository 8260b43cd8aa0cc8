"""What a process gives its loop: the best priority that it is granted, algebra on one core, no long collections."""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from threadpoolctl import threadpool_limits

#: real-time priority of the loop's thread: above all that is not real-time, below the kernel's own threads
PRIORITY = 20


@runtime_checkable
class GoesOn(Protocol):
    """A clock whose time goes on whether anybody waits or not."""

    goes_on: bool


def spare_collections() -> None:
    """Leave all that is in memory now out of the garbage collections to come: a full one takes 30 to 80 ms."""
    gc.collect()
    gc.freeze()


@contextlib.contextmanager
def raise_priority(clock: object) -> Iterator[None]:
    """Let this thread run before others, and small matrices not on all cores, where the clock waits for nobody.

    Parameters
    ----------
    clock : Clock
        The rig's; nothing is changed for a virtual one, which would only keep others from their work.

    Notes
    -----
    The system may refuse the priority to a user; then the loop goes on with the usual one.
    """
    if not isinstance(clock, GoesOn) or not clock.goes_on:
        yield
        return
    with threadpool_limits(limits=1), before_others():
        yield


@contextlib.contextmanager
def before_others() -> Iterator[None]:
    """Let this thread run before others, where the system grants it: the loop's, and one that it waits for."""
    if not hasattr(os, "sched_setscheduler"):
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        # programs that are started meanwhile get the usual priority
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
        given = True
    except OSError:
        given = False
    try:
        yield
    finally:
        if given:
            policy, param = before
            try:
                os.sched_setscheduler(0, policy, param)
            except OSError:  # only a privileged process may take this flag back
                os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, param)
