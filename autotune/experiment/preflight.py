"""The look at a rig before anything is moved: how often it answers, its noise, whether it is at rest."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from autotune.arrays import FloatArray
from autotune.config.procedure import OperatingPointSettings
from autotune.errors import ExperimentStopped, LinkError
from autotune.experiment.limits import START_ROOM, Watch
from autotune.experiment.loop import ControlLoop, Timing
from autotune.experiment.monitor import RECENT
from autotune.experiment.rig import Exchanges, HandsBack, Rig, RunsRelay
from autotune.points import FrequencyPoint

PREFLIGHT_SAMPLES = 60
#: share of these that may take longer than 0.8 of the sample time
SLOW_SHARE = 0.05
#: least share of readings in preflight that differ from the one before, for a sensor of which that can be expected
RESTLESS = 0.05
#: how far from u_guess the command that holds the operating point is looked for, in u_uncertainty
BRACKET = 1.2
SMALL = 1e-9
#: samples per period that an estimate needs at least
LEAST_SAMPLES = 8

Tell = Callable[[str], None]


def silent(_: str) -> None:
    """Tell nobody."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """What the procedure has learnt so far.

    Attributes
    ----------
    noise_sd, noise_half : float
        Standard deviation and half-width of the measurement noise [y unit].
    y_rest : float
        Mean measurement in preflight [y unit].
    u_held : float
        Command that was held meanwhile [u unit].
    plant_sign : int
        Sign of the plant's gain, 0 while unknown.
    sign_seen, midpoint_seen : bool
        Whether sign and mid-point, this one roughly, were seen on the rig and not only said.
    midpoint : float
        Command that holds the plant, as far as known [u unit].
    first_move_s : float
        When the plant first answered [s].
    y_moved, speed : float
        Measurement [y unit] and speed [y unit/s] when it was seen to move.
    points : tuple of FrequencyPoint
        What is known of the plant.
    swept : bool
        Whether the points are the sweep's, and not a short look.
    link_rad_s : float
        Frequency up to which the link supports points [rad/s].
    warnings : tuple of str
        What the reader should know.
    """

    noise_sd: float = 0.0
    noise_half: float = 0.0
    y_rest: float = math.nan
    u_held: float = math.nan
    plant_sign: int = 0
    sign_seen: bool = False
    midpoint_seen: bool = False
    midpoint: float = math.nan
    first_move_s: float = 0.0
    y_moved: float = math.nan
    speed: float = 0.0
    points: tuple[FrequencyPoint, ...] = ()
    swept: bool = False
    link_rad_s: float = math.inf
    warnings: tuple[str, ...] = ()


def preflight(
    loop: ControlLoop, point: OperatingPointSettings, gain_sd: float, tell: Tell, *, u_rest: float | None = None
) -> Known:
    """Look before anything moves: link, noise, a sensor that is alive and in range.

    Parameters
    ----------
    loop, point, tell
        The open loop, how its operating point is reached, and who is told.
    gain_sd : float
        Relative standard deviation at which a point is good enough.
    u_rest : float, optional
        Command that holds the operating point, where it is known from before [u unit].

    Raises
    ------
    ExperimentStopped, LinkError
        Link too slow, sensor at its rail or frozen.
    """
    tell("looking at link and noise")
    start_u = _command_to_hold(loop, point, u_rest) if point.approach == "hold" else loop.tick.u
    if point.approach == "hold" and not loop.shows_applied and _was_controlled(loop.rig):
        # its own controller held y by about this, and not by the safe output, from which the rate would kick the plant
        loop.tick = replace(loop.tick, u=start_u)
    first_row = loop.tick.k
    first: tuple[float, ...] = ()
    for _ in range(PREFLIGHT_SAMPLES):
        loop.step(loop.nearest(start_u))
        if len(first) < RECENT <= len(loop.monitor.recent):
            loop.watch = Watch(y_centre=point.y, in_range=True, y_start=median(loop.monitor.recent))
        first = first if len(first) == RECENT else loop.monitor.recent
        if point.approach == "ramp":
            _check_at_rest(loop, first_row, first)
    y = loop.history(first_row)[2][1:]
    y = y[np.isfinite(y)]
    link_rad_s = _judge_link(loop, gain_sd, tell)
    steps = np.diff(y)
    # from differences: a plant that drifts is not taken for noise; from their median: nor are a few wild readings
    typical = 1.4826 * float(np.median(np.abs(steps)))
    noise_sd = min(float(np.std(steps)), typical if typical > 0.0 else math.inf) / math.sqrt(2.0)
    noise_half = min(0.5 * float(np.max(np.abs(steps))), 3.0 * noise_sd)
    limits = loop.envelope.settings
    if noise_half > 0.4 * limits.swing:
        raise ExperimentStopped(
            f"drowned in noise: y is restless by +-{noise_half:.3g} where limits.swing allows {limits.swing:g}",
            where="preflight",
            remedy="filter the measurement at the device, or allow more swing",
        )
    changes = float(np.mean(steps != 0.0))
    loop.monitor.noise = noise_half
    loop.monitor.jump = 0.5 * limits.swing
    loop.monitor.u_tolerance = 0.02 * (limits.u_max - limits.u_min)
    if changes > RESTLESS:
        # a sensor at its rail repeats its full scale half of the time; the longest run seen says how it repeats itself
        loop.monitor.same_s = (4 * _longest_run(y) + 19.5) * loop.sample_time_s
    return Known(
        noise_sd=noise_sd,
        noise_half=noise_half,
        y_rest=float(np.mean(y)),
        u_held=start_u,
        plant_sign=point.plant_sign,
        link_rad_s=link_rad_s,
    )


def _judge_link(loop: ControlLoop, gain_sd: float, tell: Tell) -> float:
    """Refuse a link that is too slow, and return the frequency up to which it supports points [rad/s]."""
    timing = loop.timing
    typical, late, _ = timing.latency_s
    # where the device runs the relay, what the host does before may miss samples
    may_miss = isinstance(loop.rig, RunsRelay) and not isinstance(loop.rig, Exchanges)
    longest_s = 0.5 * loop.patience_s if may_miss else 0.8 * loop.sample_time_s
    # one hiccup of the computer is none of the link's
    if loop.slower_than(longest_s) > SLOW_SHARE:
        raise LinkError(
            f"link too slow: a reading takes {1e3 * typical:.3g} ms, up to {1e3 * late:.3g} ms in 99 %,"
            f" the sample time is {1e3 * loop.sample_time_s:.3g} ms",
            where="preflight",
            remedy="raise signals.sample_time_s, or use a faster link",
        )
    link_rad_s = highest_frequency_rad_s(timing, loop.sample_time_s, gain_sd, exact=loop.is_exact)
    tell(
        f"a reading takes {1e3 * typical:.2g} ms, up to {1e3 * late:.2g} ms in 99 %, and the loop is up to"
        f" {1e3 * timing.lateness_s[1]:.2g} ms late: this link supports points up to {link_rad_s:.3g} rad/s"
    )
    loop.note(link_rad_s=link_rad_s)
    return link_rad_s


def _command_to_hold(loop: ControlLoop, point: OperatingPointSettings, u_rest: float | None) -> float:
    """Return the command under which the rig is looked at where it is [u unit].

    What the rig says it applies, where y is near the operating point under it and u_guess allows it: nothing has to
    move. Else what is known to hold it, or u_guess.
    """
    applied = loop.applied
    is_there = abs(loop.tick.y - point.y) <= START_ROOM * loop.envelope.settings.swing
    is_said = loop.shows_applied and abs(applied - point.u_guess) <= BRACKET * point.u_uncertainty
    known = point.u_guess if u_rest is None else u_rest
    return applied if is_there and is_said else known


def _was_controlled(rig: Rig) -> bool:
    """Return whether the rig's own controller had the actuator until now."""
    return isinstance(rig, HandsBack) and rig.former is not None


def _check_at_rest(loop: ControlLoop, first_row: int, first: tuple[float, ...]) -> None:
    """Stop where the plant moves under the command it should rest at."""
    y = loop.history(first_row)[2]
    if len(first) < RECENT or np.isfinite(y).sum() < RECENT:
        return
    moved = median(loop.monitor.recent) - median(first)
    if abs(moved) > 0.2 * loop.envelope.settings.swing + float(np.nanmax(np.abs(np.diff(y)))):
        raise ExperimentStopped(
            f"wrong sign, or the plant moves where it should rest: y went by {moved:.3g} at u = {loop.tick.u:.4g}",
            where="preflight",
            remedy="wait until it is at rest; check limits.u_safe, and the wiring and scaling of the actuator",
        )


def _longest_run(y: FloatArray) -> int:
    """Return the length of the longest run of equal readings."""
    changes = np.flatnonzero(np.diff(y) != 0.0)
    return int(np.max(np.diff(np.concatenate([[-1], changes, [y.size - 1]]))))


def highest_frequency_rad_s(timing: Timing, sample_time_s: float, gain_sd: float, *, exact: bool) -> float:
    """Return the frequency up to which a point's error from the link stays within the wanted standard deviation.

    Parameters
    ----------
    timing : Timing
        Latencies seen so far.
    sample_time_s : float
        Control period [s].
    gain_sd : float
        Relative standard deviation that is wanted of a point, which is one of its phase as well [rad].
    exact : bool
        Whether rows carry the device's own stamps: then only the samples per period count.

    Returns
    -------
    float
        Angular frequency [rad/s].

    Notes
    -----
    A command acts about one median latency later than its row says, which is a dead time in the phase; the latency's
    scatter averages out over the samples of a period, of which the fewest are assumed.
    """
    by_samples = 2.0 * math.pi / (LEAST_SAMPLES * sample_time_s)
    typical, late, _ = timing.latency_s
    unknown_s = math.hypot(typical, (late - typical) / math.sqrt(LEAST_SAMPLES))
    if exact or not unknown_s > 0.0:  # NaN where nothing was asked for
        return by_samples
    return min(by_samples, gain_sd / unknown_s)
