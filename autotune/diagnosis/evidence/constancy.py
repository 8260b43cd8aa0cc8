"""Whether what a fitted model holds constant is: score tests against what swings, bends, enters, or passes its chain.

A parameter that swings in time adds to the chain what it multiplies, times the swing: a gain the command, a stiffness
the position, a lag or delay the rate of the reading. Each of these signals, times cos and sin of every frequency that
the recordings resolve, is sent through the linear chain; what it would explain of the residual beyond start states and
free numbers is chi-square of two degrees where the model is right (Rao's score test). No fit is needed, and nothing is
assumed of the swing's shape: a switch or a sweep has parts at those frequencies too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.residual import NEW, FreedResidual, filled, last_known
from autotune.diagnosis.evidence.swings import Swinging, explained_by_swings
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.windows import model_lag_s
from autotune.models import Place
from autotune.recording import Recording

#: Fastest swing that is looked for, in cycles per slowest lag, and the most frequencies.
FASTEST, MOST_FREQUENCIES = 0.3, 120
#: Delays of an echo that is looked for, in slowest lags.
ECHOES = (0.5, 0.75, 1.0, 1.35, 1.8, 2.4)
#: Time constants of a linear path that is looked for.
LAGS = 8
#: A swing that explains this share of what the best one explains cannot be told from it: a slow one of the gain is the
#: command's or the reading's.
AS_MUCH = 0.9
_LOAD, _GAIN = "a load", "the command, as a gain that changes would"
_STIFFNESS = "the position or level, as a stiffness or leak that changes would"
_LAG = "the rate of the reading, as a lag or delay that changes would"
#: Columns of a recording that drive nothing but the loop, and where any other may enter a model that lacks it.
NO_INPUTS = frozenset({"r", "u_applied", "dither"})
_COLUMN_ENTERS: tuple[Place, ...] = ("plant", "sensor")
#: Where something may enter that one place of the chain cannot tell from another.
_MAY_ENTER = {
    _LOAD: ("environment", "actuator", "plant"),
    _GAIN: ("actuator", "plant"),
    _STIFFNESS: ("plant", "environment"),
    _LAG: ("plant", "timing", "actuator", "sensor"),
}


@dataclass(frozen=True, kw_only=True)
class Variation:
    """What explains most of a residual among what swings, bends, or is missing as a path.

    Attributes
    ----------
    gain : float
        Predicted decrease of chi2, in units of the residual's own variance.
    places : tuple of str
        Where it may enter, or what explains about as much.
    what : str
        The signal that is multiplied or added.
    period_s : float
        Of the swing [s]; infinite for what does not swing.
    """

    gain: float
    places: tuple[str, ...]
    what: str
    period_s: float

    @property
    def sentence(self) -> str:
        """What a reader is told."""
        if np.isfinite(self.period_s):
            return f"What is left swings with a period of about {self.period_s:.2g} s together with {self.what}."
        return f"What is left goes with {self.what}."

    def as_json(self) -> dict[str, Any] | None:
        """Return it for diagnosis.json; nothing where it was not asked."""
        if self is UNASKED:
            return None
        period = self.period_s if np.isfinite(self.period_s) else None
        return {"chi2": self.gain, "places": list(self.places), "what": self.what, "period_s": period}


#: Where nobody asked what varies: equations have no path that is known to be linear.
UNASKED = Variation(gain=0.0, places=(), what="", period_s=math.inf)


def largest_variation(result: Fit, data: Data) -> Variation:
    """Return what explains most of a fit's residual among swings, bends and paths that its model does not have.

    Parameters
    ----------
    result : Fit
        A fit at its minimum.
    data : Data
        What it was fitted to.

    Returns
    -------
    Variation
        The largest of some two hundred chi-square values of two degrees of freedom: on recordings of a model that is
        right it stays below 20 (about one in two hundred exceeds it).

    Notes
    -----
    Linear in the effect and quasi-static in the swing: what is far from both is found with less power, and a model that
    is right is not accused more often. No signal knows the noise of the row that is tested, so feedback brings no bias.
    """
    left = FreedResidual(result, data)
    e = left.beyond_numbers(left.e)
    variance = float(e @ e) / left.rows
    lag, longest = model_lag_s(result.model), max(r.duration_s for r in data.recordings)
    count = int(min(FASTEST * longest / max(lag, 1e-300), MOST_FREQUENCIES))
    columns = list(_columns(left))
    multiplied, added = list(_multiplied(left)), [*_bends(left), *_paths(left, lag), *columns]
    may_enter = _MAY_ENTER | {what: ("environment",) for _, what, _ in columns}
    swinging = [Swinging(place=place, signals=signals) for place, _, signals in multiplied]
    gains = explained_by_swings(left, e, swinging, count) / variance
    found = [
        _Found(gain=float(gain), place=place, what=what, cycles=k)
        for (place, what, _), row in zip(multiplied, gains, strict=True)
        for k, gain in enumerate(row)
    ]
    with ThreadPoolExecutor(2) as pool:
        shown = pool.map(lambda one: _explained(left.shown(one[0], one[2])[:, None], e, left) / variance, added)
        found += [
            _Found(gain=gain, place=place, what=what) for (place, what, _), gain in zip(added, shown, strict=True)
        ]
    found.sort(key=lambda one: -one.gain)
    best = found[0]
    near = [one for one in found if one.cycles and one.gain >= AS_MUCH * best.gain] if best.cycles else [best]
    places = dict.fromkeys(p for one in near for p in may_enter.get(one.what, (one.place,)))
    period = longest / best.cycles if best.cycles else np.inf
    return Variation(gain=best.gain, places=tuple(places), what=best.what, period_s=period)


@dataclass(frozen=True, kw_only=True)
class _Found:
    """What one signal explains, at a number of cycles per longest recording; 0 for what does not swing."""

    gain: float
    place: Place
    what: str
    cycles: int = 0


def _multiplied(left: FreedResidual) -> Iterator[tuple[Place, str, list[FloatArray]]]:
    """Yield what a swing would multiply: place, name, and signal per recording."""
    sim, recordings = left.result.sim, left.data.recordings
    out = [filled(s) for s in left.result.signals]
    yield "plant", _LOAD, [np.ones(len(r)) for r in recordings]
    yield "actuator", _GAIN, [r.u - sim.u_offset for r in recordings]
    yield "plant", _STIFFNESS, [s[:, 2] for s in out]
    yield "sensor", "the reading, as a sensor's gain that changes would", [s[:, 0] - sim.y_offset for s in out]
    # from the row before: the row after has felt the command that answers this row's noise
    rates = [np.diff(s[:, 0], prepend=s[0, 0]) / np.gradient(r.t) for s, r in zip(out, recordings, strict=True)]
    yield "sensor", _LAG, rates


def _bends(left: FreedResidual) -> Iterator[tuple[Place, str, list[FloatArray]]]:
    """Yield what a static curve would add: second and third powers of each signal, place, and a gain over position."""
    sim, out = left.result.sim, [filled(s) for s in left.result.signals]
    speed, position, force = ([s[:, column] for s in out] for column in (1, 2, 3))
    curved: list[tuple[Place, str, list[FloatArray]]] = [
        ("actuator", "the command", [r.u - sim.u_offset for r in left.data.recordings]),
        ("plant", "the position or level", position),
        ("sensor", "the reading", [s[:, 0] - sim.y_offset for s in out]),
    ]
    if sim.chain.is_mechanical:
        curved.append(("plant", "the speed", speed))
    for place, what, signals in curved:
        yield place, f"the square of {what}", [s**2 for s in signals]
        yield place, f"the cube of {what}", [s**3 for s in signals]
    products = [x * f for x, f in zip(position, force, strict=True)]
    yield "plant", "the position or level times the plant's input", products


def _paths(left: FreedResidual, lag_s: float) -> Iterator[tuple[Place, str, list[FloatArray]]]:
    """Yield what a path that the chain lacks would add to the reading: place, name, and signal per recording."""
    sim, recordings = left.result.sim, left.data.recordings
    # the command held until the row: the row's own already answers its noise
    held = [np.concatenate([r.u[:1], r.u[:-1]]) - sim.u_offset for r in recordings]
    yield "sensor", "the command itself, as cross-talk to the reading would", held
    readings = [filled(s)[:, 0] - sim.y_offset for s in left.result.signals]
    for delay in (d * lag_s for d in ECHOES):
        past = [np.interp(r.t - delay, r.t, y) for y, r in zip(readings, recordings, strict=True)]
        yield "sensor", f"the reading {delay:.2g} s before, as an echo would", past


def linear_gain(result: Fit, data: Data) -> float:
    """Return the decrease of chi2 that any linear path from the command to the reading would bring, at most.

    Lags from the sample time to the records' length, all at once: the largest of what they and the paths of a chain
    explain is no more than chance where the model's linear dynamics are right.
    """
    left = FreedResidual(result, data)
    e = left.beyond_numbers(left.e)
    longest = max(r.duration_s for r in data.recordings)
    lags = np.geomspace(2.0 * data.sample_times[0], longest / 4.0, LAGS)
    columns = [left.shown("sensor", [_lagged(r, lag, result.sim.u_offset) for r in data.recordings]) for lag in lags]
    return _explained(np.column_stack(columns), e, left) / (float(e @ e) / left.rows)


def _lagged(r: Recording, lag_s: float, centre: float) -> FloatArray:
    """Return the command through a lag, at rest before; the row's own command is not in it."""
    keeps = math.exp(-r.sample_time_s / lag_s)
    held = np.concatenate([r.u[:1], r.u[:-1]]) - centre
    return np.asarray(lfilter([1.0 - keeps], [1.0, -keeps], held, zi=[keeps * held[0]])[0])


def _columns(left: FreedResidual) -> Iterator[tuple[Place, str, list[FloatArray]]]:
    """Yield further recorded columns, that the model may lack as an input to the plant or in the reading."""
    recordings = left.data.recordings
    for name in sorted(set.intersection(*(set(r.extra) for r in recordings)) - NO_INPUTS):
        values = [r.extra[name][last_known(np.isfinite(r.extra[name]))] for r in recordings]
        if all(np.all(np.isfinite(v)) for v in values):
            centre = float(np.mean(np.concatenate(values)))
            for place in _COLUMN_ENTERS:
                yield place, f"the column {name!r}, as a further input would", [v - centre for v in values]


def _explained(X: FloatArray, e: FloatArray, left: FreedResidual) -> float:
    """Return the decrease of |e|^2 by columns, as far as free numbers cannot imitate them."""
    before = np.sum(X**2, axis=0)
    X = left.beyond_numbers(X)
    new = np.sum(X**2, axis=0) > NEW * before
    if not new.any():
        return 0.0
    Q = np.linalg.qr(X[:, new] / np.sqrt(before[new]))[0]
    return float(np.sum((Q.T @ e) ** 2))
