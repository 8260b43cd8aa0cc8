"""Relay law: smoothed input, hysteresis, mid-point and an inserted delay of any length; a pure step.

The relay of Le & Mendes 2010, figure 3: a delay T inserted before the plant moves the limit cycle to the frequency
where arg P(j omega) = -180 deg + T omega, equation (20). The lag of smoothing, hysteresis and sampling counts towards
that delay; none of it enters an estimate, which is made from the recorded command and measurement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from autotune.errors import InputError


@dataclass(frozen=True, kw_only=True)
class RelaySettings:
    """One setting of the relay.

    Attributes
    ----------
    y_centre : float
        Measurement to oscillate around [y unit].
    midpoint : float
        Mean of the two levels [u unit].
    amplitude : float
        Half the distance between the two levels [u unit].
    hysteresis : float
        Half-width of the hysteresis on the smoothed measurement [y unit].
    delay_samples : float
        Time from a decision to its command, in samples; a fraction is allowed.
    smoothing : int
        Readings in the moving average that the relay looks at; an average of M delays by exactly (M - 1)/2 samples.
    plant_sign : {-1, 1}
        Sign of the plant's gain: 1 raises u to raise y.
    """

    y_centre: float
    midpoint: float
    amplitude: float
    hysteresis: float = 0.0
    delay_samples: float = 0.0
    smoothing: int = 1
    plant_sign: Literal[-1, 1] = 1

    def __post_init__(self) -> None:
        if not self.amplitude > 0.0:
            raise InputError(f"amplitude = {self.amplitude:g}", where="relay", remedy="it must be positive")
        if self.hysteresis < 0.0 or self.delay_samples < 0.0 or self.smoothing < 1:
            raise InputError("hysteresis and delay must not be negative, smoothing at least 1", where="relay")


@dataclass(frozen=True, kw_only=True, slots=True)
class RelayState:
    """What the relay remembers.

    Attributes
    ----------
    k : int
        Number of the next sample, on the grid of sample times: one that was missed counts.
    recent : tuple of (int, float)
        Last readings with their numbers, the newest last [y unit].
    decided : {-1, 1}
        Side the relay has decided for.
    level : {-1, 1}
        Side that is commanded now.
    pending : tuple of (float, int)
        Decisions on their way to the command: when they arrive, in samples, and their side.
    switches : int
        Decisions taken so far.
    """

    k: int = 0
    recent: tuple[tuple[int, float], ...] = ()
    decided: int = 0
    level: int = 0
    pending: tuple[tuple[float, int], ...] = ()
    switches: int = 0


def relay_step(state: RelayState, settings: RelaySettings, y: float, *, slots: int = 1) -> tuple[RelayState, float]:
    """Advance the relay by one sample.

    Parameters
    ----------
    state, settings : RelayState, RelaySettings
        The settings may change from one step to the next; decisions on their way keep their arrival.
    y : float
        Measurement of this sample [y unit].
    slots : int
        Sample times since the sample before: more than 1 where some were missed. Delay and smoothing count time, so
        that lost samples do not stretch them.

    Returns
    -------
    state : RelayState
        The next state.
    u : float
        Command to hold until the next sample [u unit]. A switch that falls between two samples is made by one command
        in between, whose area is that of the switch at its exact instant.
    """
    k = state.k + slots - 1
    recent = (*(one for one in state.recent if one[0] > k - settings.smoothing), (k, y))
    error = settings.plant_sign * (settings.y_centre - sum(reading for _, reading in recent) / len(recent))
    decided = state.decided
    if decided == 0:
        decided = 1 if error >= 0.0 else -1
    elif error > settings.hysteresis:
        decided = 1
    elif error < -settings.hysteresis:
        decided = -1
    pending = state.pending
    level = state.level if state.level != 0 else decided
    switches = state.switches
    if decided != state.decided and state.decided != 0:
        pending = (*pending, (max(k + settings.delay_samples, pending[-1][0] if pending else 0.0), decided))
        switches += 1
    mean, level, pending = _mean_level(k, level, pending)
    new = RelayState(k=k + 1, recent=recent, decided=decided, level=level, pending=pending, switches=switches)
    return new, settings.midpoint + settings.amplitude * mean


def _mean_level(
    k: int, level: int, pending: tuple[tuple[float, int], ...]
) -> tuple[float, int, tuple[tuple[float, int], ...]]:
    """Return the mean side over sample k, the side at its end, and the decisions still on their way."""
    if not pending or pending[0][0] >= k + 1:
        return float(level), level, pending
    mean, since = 0.0, float(k)
    while pending and pending[0][0] < k + 1:
        arrival = max(pending[0][0], since)
        mean += level * (arrival - since)
        since, level, pending = arrival, pending[0][1], pending[1:]
    return mean + level * (k + 1 - since), level, pending
