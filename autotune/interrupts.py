"""Ctrl-C at the wrong moment: held back while other processes start, or while something has to come to its end."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType

#: where compiled code that is about to return calls Python to make its result
_RETURNING = "numba.core.serialize"
#: time after which a signal that came there is tried again [s]
_AGAIN_S = 0.01


def raise_interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, as Python's own handler does, but never where compiled code makes its result.

    That code takes no notice of an exception there: it goes on with what it did not get, and the command ends by
    ``SystemError`` or a segmentation fault. The signal is given again when the result stands.

    Parameters
    ----------
    number : int
        The signal.
    frame : frame, optional
        Where Python was.
    """
    while frame is not None:
        if frame.f_globals.get("__name__") == _RETURNING:
            again = threading.Timer(_AGAIN_S, _give, (number,))
            again.daemon = True
            again.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _give(number: int) -> None:
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:  # wakes a main thread that waits, too
        signal.pthread_kill(main, number)
    else:
        _thread.interrupt_main(signal.Signals(number))


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
