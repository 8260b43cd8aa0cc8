"""Effects of the reading, applied to a recorded y at a size: what a logger with that effect had written.

The recorded noise passes through the effect. In a closed loop they are effects of the logger's reading, not of the one
that the controller used. A size of 1 only has to be a sensible start.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from sim.conceal.physics import Floats
from sim.recorded.rigs import Record, RefusedError

#: Largest share of the rows that a limit may cut off; smallest share of y's spread that a lag must leave.
MOST_CUT, LEAST_LEFT = 0.45, 0.8
#: Fewest spikes of a recording.
LEAST_SPIKES = 3


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Sizes of a rig's signals over all its recordings: what the effects are measured in.

    ``noise`` is the rms of the recording's own residual, ``tau`` a time constant, ``length`` the longest recording's.
    """

    u0: float
    y0: float
    du: float
    dy: float
    u_span: float
    y_low: float
    y_high: float
    noise: float
    tau: float
    length: float
    Ts: float
    unit_u: str
    unit_y: str

    @property
    def y_span(self) -> float:
        """Size of the readings' range."""
        return self.y_high - self.y_low


#: What an effect makes of one recording; the random numbers are the recording's own.
Apply = Callable[[Record, np.random.Generator], Record]


@dataclass(frozen=True, kw_only=True)
class Put:
    """An effect at one size: what it makes of a recording, and its parameters with units."""

    apply: Apply
    parameters: dict[str, tuple[float, str]]


Maker = Callable[[float, Scale, np.random.Generator], Put]


def _reading(does: Callable[[Record, np.random.Generator], Floats]) -> Apply:
    return lambda r, rng: replace(r, y=does(r, rng))


def _require_few(cut: np.ndarray) -> None:
    if np.mean(cut) > MOST_CUT:
        raise RefusedError("more than half of the readings would be cut off")


def saturation(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Limit the reading on one side."""
    upper = bool(rng.random() < 0.7)
    level = s.y_high - 0.05 * a * s.y_span if upper else s.y_low + 0.05 * a * s.y_span

    def does(r: Record, rng: np.random.Generator) -> Floats:
        _require_few(r.y > level if upper else r.y < level)
        return np.asarray(np.minimum(r.y, level) if upper else np.maximum(r.y, level))

    return Put(apply=_reading(does), parameters={"upper" if upper else "lower": (level, s.unit_y)})


def quantisation(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Round the reading to multiples of a step."""
    step = 2.0 * a * s.noise
    if step > 0.3 * s.y_span:
        raise RefusedError("the step would be a third of all that the reading does")
    return Put(
        apply=_reading(lambda r, rng: step * np.round(r.y / step)),
        parameters={"step": (step, s.unit_y)},
    )


def drift(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Let the reading wander off at a constant rate from a recording's first row on."""
    rate = float(rng.choice([-1.0, 1.0])) * a * s.noise / s.length
    if a * s.noise > s.y_span:
        raise RefusedError("the reading would wander by more than all that it does")
    return Put(apply=_reading(lambda r, rng: r.y + rate * (r.t - r.t[0])), parameters={"rate": (rate, f"{s.unit_y}/s")})


def lag(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Damp the reading by a first-order lag; y is taken as linear between rows."""
    tau = 0.15 * a * s.tau
    if tau > 0.25 * s.length:
        raise RefusedError("the lag would be as long as the recording")
    keep = math.exp(-s.Ts / tau)
    ramp = tau / s.Ts * (1.0 - keep)

    def does(r: Record, rng: np.random.Generator) -> Floats:
        at_rest = [ramp * r.y[0]]  # the first reading passes as it is
        y: Floats = lfilter([1.0 - ramp, ramp - keep], [1.0, -keep], r.y, zi=at_rest)[0]
        if np.std(y) < LEAST_LEFT * np.std(r.y):
            raise RefusedError("the lag would take more of the signal than its shape: a gain")
        return y

    return Put(apply=_reading(does), parameters={"time_constant": (tau, "s")})


def nonlinear_gain(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Bend the reading: y + c (y - y0)^2 about the model's output offset."""
    c = float(rng.choice([-1.0, 1.0])) * 0.04 * a / s.dy
    if min(1.0 + 2.0 * c * (s.y_low - s.y0), 1.0 + 2.0 * c * (s.y_high - s.y0)) < 0.1:
        raise RefusedError("the bent reading would turn round within its range")
    return Put(
        apply=_reading(lambda r, rng: r.y + c * (r.y - s.y0) ** 2),
        parameters={"second_order": (c, f"1/{s.unit_y}")},
    )


def absolute_value(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Fold the reading upwards below some value."""
    fold = s.y_low + 0.05 * a * s.y_span

    def does(r: Record, rng: np.random.Generator) -> Floats:
        _require_few(r.y < fold)
        return np.asarray(fold + np.abs(r.y - fold))

    return Put(apply=_reading(does), parameters={"fold": (fold, s.unit_y)})


def dropout(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Let the last reading stay for runs of rows."""
    share, rows = 0.02 * a, int(rng.integers(3, 15))
    if share > 0.3:
        raise RefusedError("a third of the readings would be lost")

    def does(r: Record, rng: np.random.Generator) -> Floats:
        lost = np.zeros(len(r.y), dtype=bool)
        for k in np.flatnonzero(rng.random(len(r.y)) < share / rows):
            lost[k : k + rows] = True
        lost[0] = False
        return r.y[np.maximum.accumulate(np.where(lost, 0, np.arange(len(r.y))))]

    return Put(apply=_reading(does), parameters={"share": (share, "-"), "rows": (float(rows), "-")})


def outliers(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Add a spike of either sign to single rows."""
    size = float(rng.uniform(6.0, 15.0)) * s.noise
    share = 0.02 * a**2 * (s.noise / size) ** 2 * 50.0
    if share > 0.2 or size > s.y_span:
        raise RefusedError("a fifth of the rows would have a spike, or spikes would be larger than all that y does")

    def does(r: Record, rng: np.random.Generator) -> Floats:
        if share * len(r.y) < LEAST_SPIKES:
            raise RefusedError("fewer than three spikes")
        hit, sign = rng.random(len(r.y)) < share, np.sign(rng.random(len(r.y)) - 0.5)
        return np.asarray(r.y + np.where(hit, sign * size, 0.0))

    return Put(apply=_reading(does), parameters={"share": (share, "-"), "size": (size, s.unit_y)})


def dead_time(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Let readings arrive whole rows late; in open loop this is the same recording as with late commands."""
    rows = max(1, round(0.1 * a * s.tau / s.Ts))
    if rows * s.Ts > 0.2 * s.length:
        raise RefusedError("the dead time would be a fifth of the recording")
    return Put(
        apply=lambda r, rng: replace(r.rows(slice(rows, None)), y=r.y[:-rows]),
        parameters={"dead_time": (rows * s.Ts, "s")},
    )


def jitter(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Take readings early or late by a random time, with even stamps; y is taken as linear between rows."""
    sd = 0.15 * a * s.Ts
    if sd > 0.45 * s.Ts:
        raise RefusedError("readings would be taken after the next one's time")
    return Put(
        apply=_reading(lambda r, rng: np.interp(r.t + sd * np.clip(rng.normal(size=len(r.t)), -2, 2), r.t, r.y)),
        parameters={"sd": (sd, "s")},
    )


def clock_error(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Let the reading be older and older: y(t - e t) from the first row on; y is taken as linear between rows."""
    error = 0.1 * a * s.tau / s.length
    if error > 0.1:
        raise RefusedError("the clock would be wrong by more than a tenth")
    return Put(
        apply=_reading(lambda r, rng: np.interp(r.t - error * (r.t - r.t[0]), r.t, r.y)),
        parameters={"relative": (error, "-")},
    )
