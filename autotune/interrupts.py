"""Ctrl-C at the wrong moment: held back while other processes start, or while something has to come to its end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def interrupt_held() -> Iterator[None]:
    """Hold Ctrl-C back while the block starts processes: it is raised after the block, and they never hear one.

    A terminal sends Ctrl-C to every process of a command, those included that are still importing and would each print
    a traceback. A signal that is blocked where a process is started is blocked in it from its first instruction on.
    """
    if not hasattr(signal, "pthread_sigmask") or threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))  # another thread may hear it
    resource_tracker.ensure_running()  # whoever starts it first has SIGINT unblocked in its thread
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
    if came:
        raise KeyboardInterrupt


@contextmanager
def interrupt_deferred() -> Iterator[None]:
    """Let the block come to its end: a Ctrl-C meanwhile is raised after it, unless the block raises something else."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
    if came:
        raise KeyboardInterrupt
