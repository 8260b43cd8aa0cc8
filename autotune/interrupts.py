"""Ctrl-C at the wrong moment: held back while other processes start, or while something has to come to its end."""

from __future__ import annotations

import _thread
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

#: where an exception is lost: compiled code that calls Python to make its result, and a module that is half imported
_RETURNING, _IMPORTING = "numba.core.serialize", "importlib._bootstrap"
#: time after which a signal that came there is given again [s]; time it may wait for an import in all [s], since a
#: model's file may compute without end while it is imported; time after which that begins anew [s]
_AGAIN_S, _LONGEST_S, _ANEW_S = 0.01, 3.0, 60.0
_waits_since: list[float] = []


def raise_interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, as Python's own handler does, but never where nobody would take it for one.

    Compiled code that makes its result takes no notice of an exception, goes on with what it did not get, and ends by
    ``SystemError`` or a segmentation fault; a compiled module that is being imported says that it cannot be. There the
    signal is given again a little later.

    Parameters
    ----------
    number : int
        The signal.
    frame : frame, optional
        Where Python was.
    """
    while frame is not None:
        where = frame.f_globals.get("__name__")
        if where == _RETURNING or (where == _IMPORTING and _may_wait()):
            again = threading.Timer(_AGAIN_S, _give, (number,))
            again.daemon = True
            again.start()
            return
        frame = frame.f_back
    _waits_since.clear()
    raise KeyboardInterrupt


def _may_wait() -> bool:
    now = time.monotonic()
    if not _waits_since or now - _waits_since[0] > _ANEW_S:  # whoever heard an earlier one did not say so here
        _waits_since[:] = [now]
    return now - _waits_since[0] < _LONGEST_S


def _give(number: int) -> None:
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:  # wakes a main thread that waits, too
        signal.pthread_kill(main, number)
    else:
        _thread.interrupt_main(signal.Signals(number))


@contextmanager
def signals_heard(*numbers: signal.Signals, by: Callable[[signal.Signals], object]) -> Iterator[None]:
    """Have a block hear signals in place of whoever hears them outside of it; not in another thread than the main one.

    Parameters
    ----------
    *numbers : Signals
        Which.
    by : callable
        Is called with the one that came.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {one: signal.signal(one, lambda number, _: by(signal.Signals(number))) for one in numbers}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


@contextmanager
def interrupt_held() -> Iterator[None]:
    """Hold Ctrl-C back while the block starts processes: it is raised after the block, and they never hear one.

    A terminal sends Ctrl-C to every process of a command, those included that are still importing and would each print
    a traceback. A signal that is blocked where a process is started is blocked in it from its first instruction on.
    """
    from multiprocessing import resource_tracker

    if not hasattr(signal, "pthread_sigmask") or threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    with signals_heard(signal.SIGINT, by=came.append):  # another thread may hear it
        resource_tracker.ensure_running()  # whoever starts it first has SIGINT unblocked in its thread
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    if came:
        raise KeyboardInterrupt


@contextmanager
def interrupt_deferred() -> Iterator[None]:
    """Let the block come to its end: a Ctrl-C meanwhile is given after it, unless the block raises something itself.

    It then goes to whoever hears Ctrl-C outside of the block: a control loop ends its experiment by it.
    """
    came: list[int] = []
    with signals_heard(signal.SIGINT, by=came.append):
        yield
    if came:
        signal.raise_signal(signal.SIGINT)
