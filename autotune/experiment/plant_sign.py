"""The sign of the plant's gain, from which way y turns when the command is pushed up, down and up again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from autotune.config.procedure import OperatingPointSettings
from autotune.errors import ExperimentStopped
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import noise_half
from autotune.experiment.preflight import SMALL, Known, Tell

#: rows over which y must stand still or move uniformly before it is pushed; twice as many with every new attempt, for
#: a plant that did not turn with the pushes is slower than it seemed
STEADY_ROWS = 60
#: how far the means of three thirds of these may be from a straight line, in what y is pushed by; beside noise alone
BEND_SHARE = 0.03
#: parts of limits.time_s: for one push, and for all
PUSH_SHARE, ALL_SHARE = 0.1, 0.3
#: a plant that answered turns again within so many times what it took so far
AGAIN = 4.0


def find_sign(loop: ControlLoop, point: OperatingPointSettings, known: Known, tell: Tell) -> Known:
    """Push the command up, down and up again until y turns with every push.

    A plant that is still on its way when it is pushed (cold, after a load, ringing) moves as it would have moved
    anyway; one with dead time goes on after the command has changed. What counts is therefore a steady course before
    the first push, and three departures from it in turn.

    Parameters
    ----------
    loop, point, known, tell
        As :func:`autotune.experiment.approach.approach`.

    Raises
    ------
    ExperimentStopped
        y does not turn with the command.
    """
    tell("waiting for a steady y, then finding the sign of the plant's gain")
    limits, push = loop.envelope.settings, 0.5 * point.u_uncertainty
    distance = 0.1 * limits.swing
    deadline_s = loop.tick.t_s + ALL_SHARE * limits.time_s
    rows = STEADY_ROWS
    while loop.tick.t_s < deadline_s:
        course = _await_steady_course(loop, known.midpoint, rows, BEND_SHARE * distance, deadline_s)
        rows *= 2
        # by now nothing of a movement is taken for noise
        distance = 0.1 * limits.swing + 4.0 * noise_half(loop)
        patience_s, side = PUSH_SHARE * limits.time_s, 0
        pushes: list[_Push] = []
        for direction in (1, -1, 1):
            command = known.midpoint + direction * push
            pushes.append(_push(loop, command, course, side=-side, distance=distance, patience_s=patience_s))
            side = pushes[-1].side
            if side == 0:
                break
            patience_s = min(patience_s, AGAIN * (loop.tick.t_s - course.start_s))
        else:
            # the command at which y would have stood still, from how fast it moved before the pushes
            faster = 0.5 * abs(pushes[0].speed - pushes[1].speed)
            balance = -side * course.speed / max(faster, SMALL)
            midpoint = known.midpoint + push * min(max(balance, -2.0), 2.0)
            return replace(known, plant_sign=side, sign_seen=True, midpoint=midpoint)
    raise ExperimentStopped(
        f"the plant does not answer: y does not turn by {distance:.3g} with commands {push:.3g} above and below"
        " u_guess",
        where="approach",
        remedy="wait until y is at rest; look for a stuck actuator; else raise operating_point.u_uncertainty, or say"
        " operating_point.plant_sign",
    )


@dataclass(frozen=True, kw_only=True)
class _Course:
    """The straight line that y follows under a held command: from when [s], where it was [y unit], how fast."""

    start_s: float
    level: float
    speed: float

    def departure(self, loop: ControlLoop) -> float:
        """Return how far y is from it now [y unit]."""
        return median(loop.monitor.recent) - self.level - self.speed * (loop.tick.t_s - self.start_s)


@dataclass(frozen=True, kw_only=True)
class _Push:
    """To which side of its course y turned under a push (0: to none), and its mean speed meanwhile [y unit/s]."""

    side: int
    speed: float


def _await_steady_course(loop: ControlLoop, u: float, rows: int, bend: float, deadline_s: float) -> _Course:
    """Hold a command until y stands still or moves uniformly: an integrating plant does not rest."""
    start = loop.tick.k - STEADY_ROWS
    while True:
        t, _, y = loop.history(max(0, loop.tick.k - rows))
        known = np.isfinite(y)
        first, second, third = (float(np.mean(part)) for part in np.array_split(y[known], 3))
        # twice the standard deviation of that difference over noise alone
        noise = noise_half(loop) * (18.0 / rows) ** 0.5
        is_steady = loop.tick.k - start >= rows and abs(third - 2.0 * second + first) < bend + noise
        if is_steady or loop.tick.t_s >= deadline_s:
            speed, level = np.polyfit(t[known] - t[-1], y[known], 1)
            return _Course(start_s=float(t[-1]), level=float(level), speed=float(speed))
        loop.step(loop.nearest(u))


def _push(loop: ControlLoop, u: float, course: _Course, *, side: int, distance: float, patience_s: float) -> _Push:
    """Hold a command until y has turned by a distance to a side of its course (0: to either)."""
    start_s, y = loop.tick.t_s, median(loop.monitor.recent)
    lowest = highest = course.departure(loop)
    turned = 0
    while turned == 0 and loop.tick.t_s - start_s < patience_s:
        loop.step(loop.nearest(u))
        now = course.departure(loop)
        lowest, highest = min(lowest, now), max(highest, now)
        if side >= 0 and now - lowest >= distance:
            turned = 1
        elif side <= 0 and highest - now >= distance:
            turned = -1
    speed = (median(loop.monitor.recent) - y) / max(loop.tick.t_s - start_s, SMALL)
    return _Push(side=turned, speed=speed)
