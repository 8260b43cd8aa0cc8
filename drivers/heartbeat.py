"""The heartbeat of a session: which beat is written next, and which echo of it a device may still show."""

from __future__ import annotations

import math
import random
from collections import deque

#: beats that are remembered; the last of them was written long before any tolerated lateness
_KEPT = 256


class Heartbeat:
    """A counter that the host writes and the device echoes, some program cycles late.

    Parameters
    ----------
    beats : int
        How many values the counter has before it begins again.
    late_s : float
        Longest time for which a device still shows an earlier echo [s].

    Attributes
    ----------
    value : int
        The last beat that was written.
    fed_s : float
        When that was [s]; minus infinity where none was.
    """

    def __init__(self, beats: int, *, late_s: float) -> None:
        # a device that was left with an old heartbeat must not seem to echo the first one
        self.value = random.randrange(beats)
        self.fed_s = -math.inf
        self._beats = beats
        self._late_s = late_s
        self._first_s = math.inf
        self._is_seen = False  # whether an echo of this session was shown
        self._earlier: deque[tuple[int, float]] = deque(maxlen=_KEPT)

    @property
    def next(self) -> int:
        """The beat to write now."""
        return (self.value + 1) % self._beats

    def begin(self) -> None:
        """Begin a session: nothing is to be echoed yet."""
        self.fed_s, self._first_s = -math.inf, math.inf
        self._is_seen = False
        self._earlier.clear()

    def written(self, now_s: float) -> None:
        """Take note that :attr:`next` was written and acknowledged at ``now_s`` [s]."""
        if self.is_begun:
            self._earlier.append((self.value, now_s))
        self.value = self.next
        self.fed_s = now_s
        self._first_s = min(self._first_s, now_s)

    @property
    def is_begun(self) -> bool:
        """Whether a beat was written in this session."""
        return self._first_s < math.inf

    def allows(self, echo: float, asked_s: float) -> bool:
        """Return whether the device may show this echo.

        Parameters
        ----------
        echo : float
            The beat that the device shows.
        asked_s : float
            When it was asked [s].
        """
        if self.is_own(echo, asked_s):
            return True
        # what an earlier session left is shown until the first of our own
        return not self._is_seen and asked_s - self._first_s <= self._late_s

    def is_own(self, echo: float, asked_s: float) -> bool:
        """Return whether the echo is of a beat of this session that the device may still show; from then on all are.

        Parameters
        ----------
        echo : float
            The beat that the device shows.
        asked_s : float
            When it was asked [s].
        """
        late = (until_s for beat, until_s in self._earlier if beat == echo)
        own = self.is_begun and (echo == self.value or any(asked_s - until_s <= self._late_s for until_s in late))
        self._is_seen = self._is_seen or own
        return own
