"""How quick a link is: which sample times cyclic reads and confirmed commands keep up with."""

from __future__ import annotations

import math
from collections.abc import Iterable
from statistics import median

from drivers.register_link import RegisterLink
from drivers.registers import Codec, blocks

#: readings that are timed
_READINGS = 20
#: part of a sample time that a reading and the command after it may take, at the slowest that was seen
_SHARE = 0.5


def shortest_sample_s(slowest_s: float) -> float:
    """Return the shortest of 1, 2, 5, 10, ... ms of which a reading of so long and a command leave half [s]."""
    wanted_s = max(2.0 * slowest_s / _SHARE, 1e-3)
    power = 10.0 ** math.floor(math.log10(wanted_s) + 1e-9)
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= wanted_s * (1.0 - 1e-9))


def tell_pace(link: RegisterLink, sample: Iterable[Codec]) -> str:
    """Read a sample some times and return what that says of sample times.

    Parameters
    ----------
    link : RegisterLink
        Connected; nothing is written.
    sample : iterable of Codec
        Signals that a sample is made of.

    Raises
    ------
    LinkError
        No answer, or a signal that the device refuses.

    Notes
    -----
    On a quiet link and computer as they were then: what a run meets stands in its report.
    """
    requests = blocks(list(sample))
    took_s = [sum(link.read(block).took_s for block in requests) for _ in range(_READINGS)]
    return (
        f"a sample takes {1e3 * median(took_s):.2g} ms to read, {1e3 * max(took_s):.2g} ms at worst of {_READINGS}:"
        f" cyclic reads keep up with sample times from {1e3 * shortest_sample_s(max(took_s)):g} ms on"
    )
