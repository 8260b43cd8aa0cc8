"""The sign of the plant's gain, from which way y turns when the command is pushed up, down and up again."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from autotune.config.procedure import OperatingPointSettings
from autotune.errors import ExperimentStopped
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import noise_half
from autotune.experiment.preflight import BRACKET, SMALL, Known, Tell

#: rows over which y must stand still or move uniformly before it is pushed; twice as many with every new attempt, for
#: a plant that did not turn with the pushes is slower than it seemed
STEADY_ROWS = 60
#: how far the means of three thirds of these may be from a straight line, in what y is pushed by; beside noise alone
BEND_SHARE = 0.03
#: parts of limits.time_s: for one push, and for all
PUSH_SHARE, ALL_SHARE = 0.1, 0.3
#: a plant that answered turns again within so many times what it took so far
AGAIN = 4.0
#: rows in which a push grows: a plant with dead time goes on by what it was pushed until it was seen to move
PUSH_ROWS = 100
#: parts of limits.swing: how far y may be before it is brought back, and beyond where it began
GUARD, AWAY = 0.4, 0.2
#: times what counts as a turn that y leaves its course by until the sign that should bring it back is the wrong one
FASTER = 1.5
#: rows in which the command goes to the end of what u_guess may be wrong by, to bring y back
BACK_ROWS = 50


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
    rows, guard = STEADY_ROWS, _guard(loop, point)
    patience_s, likely = PUSH_SHARE * limits.time_s, 0
    while loop.tick.t_s < deadline_s:
        steady = _Steady(rows=rows, bend=BEND_SHARE * distance, guard=guard, deadline_s=deadline_s)
        course = _await_steady_course(loop, known.midpoint, steady)
        rows *= 2
        # by now nothing of a movement is taken for noise
        distance = 0.1 * limits.swing + 4.0 * noise_half(loop)
        if guard.is_left(loop):
            sign = _bring_back(loop, point, known, course, distance, likely)
            return replace(known, plant_sign=sign, sign_seen=True)
        longest_s, side = patience_s, 0
        pushes: list[_Push] = []
        for direction in (1, -1, 1):
            wanted = _Wanted(u=known.midpoint + direction * push, side=-side, distance=distance, guard=guard)
            pushes.append(_push(loop, known.midpoint, wanted, course, longest_s))
            side = pushes[-1].side
            if side == 0:
                break
            likely = direction * side
            longest_s = min(longest_s, AGAIN * (loop.tick.t_s - course.start_s))
        else:
            # the command at which y would have stood still, from how fast it moved before the pushes
            by = abs(pushes[0].speed - pushes[1].speed) / (pushes[0].u - pushes[1].u)
            aside = -course.speed * side / max(by, SMALL)
            midpoint = known.midpoint + min(max(aside, -2.0 * push), 2.0 * push)
            return replace(known, plant_sign=side, sign_seen=True, midpoint_seen=True, midpoint=midpoint)
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
class _Guard:
    """How far from a centre y may be before it is brought back [y unit]; infinite where it comes from further away."""

    centre: float
    reach: float

    def is_left(self, loop: ControlLoop) -> bool:
        """Whether y is further away now."""
        return abs(median(loop.monitor.recent) - self.centre) > self.reach


def _guard(loop: ControlLoop, point: OperatingPointSettings) -> _Guard:
    swing, start = loop.envelope.settings.swing, loop.watch.y_start
    away = 0.0 if start is None else abs(start - point.y)
    return _Guard(centre=point.y, reach=max(GUARD * swing, away + AWAY * swing) if away < GUARD * swing else math.inf)


@dataclass(frozen=True, kw_only=True)
class _Steady:
    """When y is steady: means of thirds of so many rows on a line to within a bend; or it leaves the guard; or late."""

    rows: int
    bend: float
    guard: _Guard
    deadline_s: float


@dataclass(frozen=True, kw_only=True)
class _Wanted:
    """A push to a command [u unit], until y turns by a distance [y unit] to a side (0: either), or leaves a guard."""

    u: float
    side: int
    distance: float
    guard: _Guard


@dataclass(frozen=True, kw_only=True)
class _Push:
    """To which side of its course y turned under a push (0: to none), its mean speed [y unit/s], the mean command."""

    side: int
    speed: float
    u: float


def _await_steady_course(loop: ControlLoop, u: float, steady: _Steady) -> _Course:
    """Hold a command until y stands still or moves uniformly: an integrating plant does not rest."""
    start, rows = loop.tick.k - STEADY_ROWS, steady.rows
    while True:
        t, _, y = loop.history(max(0, loop.tick.k - rows))
        known = np.isfinite(y)
        first, second, third = (float(np.mean(part)) for part in np.array_split(y[known], 3))
        # twice the standard deviation of that difference over noise alone
        noise = noise_half(loop) * (18.0 / rows) ** 0.5
        is_steady = loop.tick.k - start >= rows and abs(third - 2.0 * second + first) < steady.bend + noise
        is_left = steady.guard.is_left(loop)
        if is_steady or is_left or loop.tick.t_s >= steady.deadline_s:
            if is_left:  # what bends goes on as it went at last
                known[: 2 * known.size // 3] = False
            speed, level = np.polyfit(t[known] - t[-1], y[known], 1)
            return _Course(start_s=float(t[-1]), level=float(level), speed=float(speed))
        loop.step(loop.nearest(u))


def _push(loop: ControlLoop, midpoint: float, wanted: _Wanted, course: _Course, patience_s: float) -> _Push:
    """Let the command go to one side, further with every sample, until y has turned from its course."""
    start_s, y = loop.tick.t_s, median(loop.monitor.recent)
    lowest = highest = course.departure(loop)
    turned, total, rows = 0, 0.0, 0
    while turned == 0 and loop.tick.t_s - start_s < patience_s and not wanted.guard.is_left(loop):
        rows += 1
        u = loop.nearest(midpoint + min(rows / PUSH_ROWS, 1.0) * (wanted.u - midpoint))
        total += u
        loop.step(u)
        now = course.departure(loop)
        lowest, highest = min(lowest, now), max(highest, now)
        if wanted.side >= 0 and now - lowest >= wanted.distance:
            turned = 1
        elif wanted.side <= 0 and highest - now >= wanted.distance:
            turned = -1
    speed = (median(loop.monitor.recent) - y) / max(loop.tick.t_s - start_s, SMALL)
    return _Push(side=turned, speed=speed, u=total / max(rows, 1))


def _bring_back(
    loop: ControlLoop, point: OperatingPointSettings, known: Known, course: _Course, distance: float, likely: int
) -> int:
    """Move the command until y comes back, as far as u_guess may be wrong, and return the sign that did it.

    Where no push has told the sign most plants' is tried first, and where y then goes away faster the other one.
    """
    sign, y, limits = likely or 1, median(loop.monitor.recent), loop.envelope.settings
    side = 1 if y > point.y else -1
    farthest, share, turned_s = side * y, 0.0, loop.tick.t_s
    while True:
        share = min(share + 1.0 / BACK_ROWS, 1.0)
        loop.step(loop.nearest(known.midpoint - sign * side * share * BRACKET * point.u_uncertainty))
        now = side * median(loop.monitor.recent)
        farthest = max(farthest, now)
        if farthest - now >= distance:
            return sign
        is_faster = likely == 0 and side * course.departure(loop) > FASTER * distance
        if is_faster or loop.tick.t_s - turned_s > PUSH_SHARE * limits.time_s:
            sign, likely, turned_s = -sign, -sign, loop.tick.t_s
