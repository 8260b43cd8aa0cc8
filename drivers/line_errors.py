"""The one place where an error of the operating system on a line, of whatever transport, becomes a LinkError."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from autotune.errors import LinkError

LINE_ERRORS: tuple[type[Exception], ...] = (OSError,)  # sockets, TLS, pyserial: all of theirs are OSErrors
try:
    import termios

    LINE_ERRORS += (termios.error,)  # raised for line settings that the device refuses; it is no OSError
except ImportError:  # there is none outside POSIX
    pass

CABLE = "check cable and power of the device"

#: of a line on which what is sent comes back
ECHO = "the line echoes what is sent"
ECHO_REMEDY = "part RX from TX (a jumper, a loop-back plug), switch the adapter's local echo off, check rig.device"


@contextmanager
def line_errors(
    where: str, what: str = "the connection was lost", remedy: str = CABLE, *, also: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """Raise a LinkError where the block meets an error of the line.

    Parameters
    ----------
    where : str
        The device, for the message.
    what, remedy : str
        What the error means, and what to do about it.
    also : tuple of exception types
        What a library raises in the same sense.

    Raises
    ------
    LinkError
        In the place of what the line raised: resets, refusals, broken pipes, unplugged ports, TLS alerts.
    """
    try:
        yield
    except LinkError:  # is an OSError itself, and has its words already
        raise
    except (*LINE_ERRORS, *also) as error:
        raise LinkError(f"{what} ({_words(error)})", where=where, remedy=remedy) from None


def _words(error: Exception) -> str:
    """Return the error's words, without the prefixes that libraries and the operating system put before them."""
    words = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return str(words).removeprefix("Modbus Error: ").removeprefix("[Connection] ").strip()
