"""Search for the step and the origin of a converter in the command: no derivative leads to them."""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray
from autotune.effects.base import FEW_LEVELS, Scan

#: Steps that are tried, as shares of the standard deviation of u: from a known origin, and as lines over u.
_STEPS_TRIED, _LINES_OVER = (0.01, 3.0), (0.02, 3.0)
#: How closely lines over u are looked at, as a share of a line's width; lines that are tried.
_LINE_SHARE, _LINES_TRIED = 0.3, 24
#: Shift of the farthest command's phase from one step tried to the next, in steps, and steps at most from one origin:
#: where a command takes many values, and few, of which each is rounded the other way at steps of its own.
_MANY, _FEW = (0.2, 4_000), (0.02, 20_000)
#: Steps tried at one time.
_AT_ONCE = 128
#: What is followed, of all that was tried.
_KEPT = 2

_Level = tuple[float, float]


def converter_steps(scan: Scan) -> list[tuple[float, ...]]:
    """Return the best steps and origins of a converter.

    Converters count from zero or from the operating point: from there every step is tried. For any other origin lines
    of the residual over u are tried. The best of each are followed; an origin is the level nearest to the middle of u,
    so that a small error of the step does not move the levels away.
    """
    u = scan.commands
    middle, spread, span = float(np.median(u)), float(np.std(u)), float(np.ptp(u))
    if spread == 0.0:
        return []

    def tried(levels: list[_Level]) -> list[tuple[float, tuple[float, ...]]]:
        """Return what is predicted of steps with the phase at which a level lies above the middle of u."""
        found = scan.predicted([(step, middle + step * phase) for step, phase in levels])
        return sorted(found, key=lambda one: -one[0])

    def followed(levels: list[_Level]) -> list[tuple[float, tuple[float, ...]]]:
        """Return what is predicted of the best step and origin, and around them."""
        best = tried(levels)[:_KEPT]
        width, turn = _LINE_SHARE, 0.1
        for _ in range(4):
            near = []
            for _, (step, origin) in best:
                phase = (origin - middle) / step
                beside = [step / (1.0 + i * width * step / span) for i in (-1, 0, 1)]
                near += [(h, phase + turn * k) for i, h in enumerate(beside) for k in (-1, 0, 1) if i != 1 or k]
            best = sorted((*best, *tried(near)), key=lambda one: -one[0])[:_KEPT]
            width, turn = 0.5 * width, 0.5 * turn
        return best[:1]

    found = followed(_lines(scan, middle))
    for origin in {0.0, scan.operating_command}:
        turns = [(step, (origin - middle) / step) for step in _steps_from_origin(scan, origin)]
        found += followed([(step, phase - round(phase)) for step, phase in turns])
    decrease, values = max(found, default=(0.0, ()))
    return [values] if decrease > 0.0 else []


def _steps_from_origin(scan: Scan, origin: float) -> list[float]:
    """Return the steps that predict most where they are counted from a known origin.

    A command that takes few values is rounded the other way at certain steps only: they are tried more closely. Where
    commands are far from the origin for their spread, so many steps would have to be tried that any phase has its
    chance: the origin tells nothing.
    """
    values, spread = scan.levels, float(np.std(scan.commands))
    far = float(np.max(np.abs(values - origin)))
    shift, most = _FEW if values.size <= FEW_LEVELS else _MANY
    smallest, largest = (share * spread for share in _STEPS_TRIED)
    if far / (shift * smallest) > most:
        return []
    steps = 1.0 / np.arange(1.0 / largest, 1.0 / smallest, shift / far)
    decreases = np.empty(steps.size)
    for a in range(0, steps.size, _AT_ONCE):
        h = steps[a : a + _AT_ONCE, None]
        decreases[a : a + _AT_ONCE] = scan.commanded(origin + h * np.floor((values - origin) / h + 0.5) - values)
    return [float(h) for h in steps[np.argsort(-decreases)][:_KEPT]]


def _lines(scan: Scan, middle: float) -> list[_Level]:
    """Return steps, and how far above the middle of u a level lies in steps, from lines of the residual over u.

    A converter adds a saw-tooth of u, whose period is its step: its fundamental is a line of the influence's
    periodogram over the command, as a periodic load's is one over time.
    """
    u, influence = scan.influence()
    spread, span = float(np.std(u)), float(np.ptp(u))
    smallest, largest = _LINES_OVER
    per_step = np.arange(1.0 / (largest * spread), 1.0 / (smallest * spread), _LINE_SHARE / span)
    values, where = np.unique(u - middle, return_inverse=True)
    weights = np.bincount(where, influence)
    lines, turned = np.empty(per_step.size, dtype=np.complex128), np.exp(2j * np.pi * per_step[0] * values)
    turn = np.exp(2j * np.pi * _LINE_SHARE / span * values)
    for i in range(per_step.size):  # evenly spaced: from one to the next every value turns on by the same angle
        lines[i] = weights @ turned
        turned *= turn
    power: FloatArray = np.abs(lines)
    inner = np.flatnonzero((power >= np.append(power[1:], 0.0)) & (power >= np.append(0.0, power[:-1])))
    # round(x) - x = -sin(2 pi x)/pi + ...: where the line's phase puts the fall through zero there is a level
    turns = (np.angle(lines) / (2.0 * np.pi) + 0.25 + 0.5) % 1.0 - 0.5
    return [(float(1.0 / per_step[i]), float(turns[i])) for i in inner[np.argsort(-power[inner])][:_LINES_TRIED]]
