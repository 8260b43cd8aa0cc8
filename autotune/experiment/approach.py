"""The states before the sweep: preflight, approach to the operating point, search for the relay's mid-point."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import median
from typing import NoReturn

import numpy as np

from autotune.config.procedure import OperatingPointSettings
from autotune.errors import ExperimentStopped, IdentificationError
from autotune.experiment.limits import Watch
from autotune.experiment.local_model import lag_beyond_integrator
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import Oscillation, mean_command, noise_half, too_noisy
from autotune.experiment.plant_sign import find_sign
from autotune.experiment.preflight import BRACKET, SMALL, Known, Tell
from autotune.experiment.relay import RelaySettings
from autotune.identification.envelope import polar_sd
from autotune.identification.frequency.limit_cycle_points import limit_cycle_points

#: smoothing of the relay while nothing is known of the plant
FIRST_SMOOTHING = 5
#: samples in which a ramp goes through one u_uncertainty, and the sample time [s] below which a host ramps no faster
RAMP_SAMPLES, RAMP_SAMPLE_S = 600.0, 0.01
#: part of limits.swing that y moves by, beside the noise, before the plant counts as moving
MOVED_SHARE = 0.15
#: part of the time in which a ramp goes through one u_uncertainty that the plant gets to move at its end
MARGIN_SHARE = 1.0 / 3.0
#: parts of limits.time_s to wait for a first switch in all, and before the mid-point is moved
PATIENCE_SHARE, NUDGE_SHARE = 0.25, 0.02
#: part of the way to the operating point that the relay's centre begins ahead of the plant
LEAD = 0.4


def approach(
    loop: ControlLoop, point: OperatingPointSettings, known: Known, tell: Tell, *, u_rest: float | None = None
) -> Known:
    """Bring the plant to where it answers, and learn the sign of its gain and a first guess of the mid-point.

    Parameters
    ----------
    loop, point, known, tell
        The open loop, where it is commissioned and how to get there, what is known, and who is told.
    u_rest : float, optional
        Command that holds the operating point, where it is known from before: makes the ramp short [u unit].

    Raises
    ------
    ExperimentStopped
        The plant does not answer, answers before it should, or with the sign it should not have.
    """
    if point.approach == "ramp":
        return _ramp(loop, point, known, tell, u_rest)
    known = replace(known, midpoint=u_rest if u_rest is not None else known.u_held, y_moved=point.y)
    known = replace(known, first_move_s=loop.tick.t_s)
    return known if known.plant_sign != 0 else find_sign(loop, point, known, tell)


def _ramp(loop: ControlLoop, point: OperatingPointSettings, known: Known, tell: Tell, u_rest: float | None) -> Known:
    """Ramp the command from its own side through where u_guess and its uncertainty allow, until y leaves its rest."""
    limits = loop.envelope.settings
    usual = point.u_uncertainty / (RAMP_SAMPLES * max(loop.sample_time_s, RAMP_SAMPLE_S))
    rate = point.ramp_rate if point.ramp_rate is not None else usual
    begin, end = _way_of_ramp(loop, point, u_rest)
    slope = math.copysign(rate, end - begin)
    while abs(loop.tick.u - begin) > rate * loop.sample_time_s + loop.envelope.u_step:
        loop.step(loop.nearest(begin))
    tell(f"ramping the command from {begin:.3g} to {end:.3g} until the plant moves")
    distance = 2.0 * known.noise_half + MOVED_SHARE * limits.swing
    start_s = half_s = loop.tick.t_s
    moved = 0.0
    while abs(moved) < distance:
        travel = rate * (loop.tick.t_s - start_s)
        if travel > abs(end - begin) + MARGIN_SHARE * point.u_uncertainty:
            raise ExperimentStopped(
                f"the plant does not answer: y stays at {known.y_rest:.4g} up to the command {end:.4g}",
                where="approach",
                remedy="look for a stuck or saturated actuator; else correct operating_point.u_guess or u_uncertainty",
            )
        tick = loop.step(loop.nearest(begin + math.copysign(min(travel, abs(end - begin)), slope)))
        moved = median(loop.monitor.recent) - known.y_rest
        half_s = tick.t_s if abs(moved) < 0.5 * distance else half_s
    # y leaves like time to the power 2 to 3: it has gone half of the way after 0.76 of the time
    since = min((loop.tick.t_s - half_s) / 0.24, loop.tick.t_s - start_s)
    sign = _sign_of(moved, slope * (loop.tick.t_s - start_s), loop, known)
    return replace(
        known,
        plant_sign=sign,
        sign_seen=True,
        midpoint_seen=True,
        midpoint=loop.tick.u - slope * since,
        first_move_s=loop.tick.t_s - since,
        y_moved=known.y_rest + moved,
        speed=2.5 * distance / since,
    )


def _way_of_ramp(loop: ControlLoop, point: OperatingPointSettings, u_rest: float | None) -> tuple[float, float]:
    """Return the commands between which to ramp [u unit], first the one on the side of what the rig holds.

    On its way to the other one the command would cross the operating point at its full rate.
    """
    limits, reach = loop.envelope.settings, BRACKET * point.u_uncertainty
    side = 1.0 if loop.tick.u > point.u_guess else -1.0
    before = reach if u_rest is None else min(reach, side * (u_rest - point.u_guess) + 0.25 * reach)
    begin, end = point.u_guess + side * before, point.u_guess - side * reach
    return min(max(begin, limits.u_min), limits.u_max), min(max(end, limits.u_min), limits.u_max)


def _sign_of(moved: float, climbed: float, loop: ControlLoop, known: Known) -> int:
    """Return the sign of the plant's gain from how y moved while the command climbed by ``climbed``, or fell."""
    sign = 1 if moved * climbed > 0 else -1
    if abs(climbed) <= 2.0 * loop.envelope.u_step:
        raise ExperimentStopped(
            f"wrong sign, or the plant moves where it should rest: y went from {known.y_rest:.4g} to"
            f" {known.y_rest + moved:.4g} at the command {loop.tick.u:.4g}",
            where="approach",
            remedy=f"check the wiring and scaling of the actuator; else {'lower' if climbed >= 0 else 'raise'}"
            " operating_point.u_guess",
        )
    if known.plant_sign not in (0, sign):
        raise ExperimentStopped(
            f"wrong sign: y moved by {moved:.3g} when the command {'rose' if climbed > 0 else 'fell'}, plant_sign is"
            f" {known.plant_sign}",
            where="approach",
            remedy="correct plant_sign, or check the wiring of actuator and sensor",
        )
    return sign


def find_midpoint(
    loop: ControlLoop, point: OperatingPointSettings, largest: float | None, known: Known, tell: Tell
) -> tuple[Known, Oscillation]:
    """Catch the plant with a relay without inserted delay, lead it to the operating point, and find the mid-point.

    Parameters
    ----------
    loop, point, known, tell
        As :func:`approach`.
    largest : float or None
        Half-amplitude of the relay that was asked for [u unit].

    Returns
    -------
    known : Known
        With mid-point, noise at the operating point and the first point.
    oscillation : Oscillation
        The relay, running, for the sweep to go on with.
    """
    limits = loop.envelope.settings
    tell("catching the plant and finding the relay's mid-point")
    midpoint, reach = _where_relay_begins(loop, point, known)
    room = min(midpoint - limits.u_min, limits.u_max - midpoint)
    amplitude = min(largest or reach, 0.9 * room)
    if amplitude <= 0.0:
        raise ExperimentStopped(
            f"saturated: the mid-point {midpoint:.4g} is at the end of the command's range",
            where="find the mid-point",
            remedy="choose another operating point, or widen limits.u_min..u_max",
        )
    settings = RelaySettings(
        y_centre=known.y_moved + LEAD * (point.y - known.y_moved),
        midpoint=midpoint,
        amplitude=amplitude,
        hysteresis=2.5 * known.noise_sd / math.sqrt(FIRST_SMOOTHING),
        smoothing=FIRST_SMOOTHING,
        plant_sign=1 if known.plant_sign > 0 else -1,
    )
    oscillation = Oscillation(
        loop,
        settings,
        patience_s=PATIENCE_SHARE * limits.time_s,
        nudge_s=NUDGE_SHARE * limits.time_s,
        sign_is_sure=known.sign_seen,
    )
    _lead(oscillation, point.y, known)
    loop.watch = Watch(y_centre=point.y, in_range=True)
    return _balance(oscillation, largest, known, tell), oscillation


def _where_relay_begins(loop: ControlLoop, point: OperatingPointSettings, known: Known) -> tuple[float, float]:
    """Return the first mid-point and how far the relay reaches to either side of it [u unit]."""
    if not known.midpoint_seen:
        return known.midpoint, BRACKET * point.u_uncertainty
    # where ramp or pushes have told the mid-point roughly, the relay need not reach across all of its uncertainty
    reach, aside = 0.4 * point.u_uncertainty, known.midpoint - known.u_held
    if point.approach == "hold" and known.plant_sign * aside * (loop.tick.y - point.y) > 0.0:
        # y is where what was held is too much if anything, and the pushes asked for more: they were seen from y's way
        # back, on which it does not stand still at the command that holds the operating point. The relay reaches both.
        return known.midpoint - 0.5 * aside, reach + 0.5 * abs(aside)
    return known.midpoint, reach


def _lead(oscillation: Oscillation, y: float, known: Known) -> None:
    """Move the relay's centre from where the plant was caught to the operating point, at the speed it had."""
    target = y
    # ahead of the plant, so that the relay pulls it away from its rest at once
    centre = known.y_moved + LEAD * (target - known.y_moved)
    step = max(known.speed, SMALL) * oscillation.loop.sample_time_s
    while centre != target:
        centre = min(centre + step, target) if centre < target else max(centre - step, target)
        oscillation.move_centre(centre)
        oscillation.step()
    while abs(oscillation.loop.tick.y - target) > 0.8 * oscillation.loop.envelope.settings.swing:
        oscillation.step()


def _balance(oscillation: Oscillation, largest: float | None, known: Known, tell: Tell) -> Known:
    """Oscillate until the duty is near one half and two whole periods agree; take the first point from them.

    The relay grows while noise hides whether the plant lags by more than an integrator.
    """
    loop = oscillation.loop
    swing = loop.envelope.settings.swing
    oscillation.change(
        oscillation.settings,
        patience_s=PATIENCE_SHARE * loop.envelope.settings.time_s,
        nudge_s=NUDGE_SHARE * loop.envelope.settings.time_s,
    )
    tries = 0
    while True:
        _, switched = oscillation.step()
        edges = oscillation.edges
        if not switched or len(edges) < 3:
            continue
        y = loop.history(edges[-3])[2]
        mean = mean_command(loop, edges)
        asymmetry = (mean - oscillation.settings.midpoint) / oscillation.settings.amplitude
        high = float(np.nanmax(y)) - float(np.nanmin(y)) - 2.0 * known.noise_half
        if abs(asymmetry) > 0.3:
            tries += 1
            if tries > 12:
                _refuse_lopsided(loop, asymmetry)
            oscillation.move_midpoint(mean)
            oscillation.forget()
        elif high > 1.7 * swing:
            oscillation.settings = replace(oscillation.settings, amplitude=0.5 * oscillation.settings.amplitude)
            oscillation.forget()
        elif len(edges) >= 5:
            t, u, y = loop.history(edges[-5] - 2)
            try:
                cycle = limit_cycle_points(t, u, y, highest_harmonic=3)
            except IdentificationError:
                if len(edges) > 20:
                    raise
                continue
            first = cycle.points[0]
            is_clear = abs(lag_beyond_integrator(first, known.plant_sign)) > 2.0 * polar_sd(first)[1]
            if not is_clear and high < 0.8 * swing and _may_double(oscillation, largest):
                oscillation.settings = replace(oscillation.settings, amplitude=2.0 * oscillation.settings.amplitude)
                oscillation.forget()
                continue
            tell(f"mid-point {cycle.u_mean:.4g}, first oscillation {first.omega_rad_s:.3g} rad/s")
            loop.monitor.noise = 2.0 * cycle.noise_sd
            return replace(
                known,
                midpoint=cycle.u_mean,
                noise_sd=cycle.noise_sd,
                noise_half=2.0 * cycle.noise_sd,
                points=(first,),
            )


def _refuse_lopsided(loop: ControlLoop, asymmetry: float) -> NoReturn:
    """Say why the duty does not come near one half."""
    if too_noisy(loop):
        raise ExperimentStopped(
            f"drowned in noise: the relay switches on noise of +-{noise_half(loop):.3g} and not on y",
            where="find the mid-point",
            remedy="filter the measurement at the device, or allow more swing",
        )
    raise ExperimentStopped(
        f"asymmetric: the command is on one side for {50 + 50 * abs(asymmetry):.0f} % of the time"
        " in spite of a corrected mid-point",
        where="find the mid-point",
        remedy="look for a drifting load or an actuator that answers up and down differently",
    )


def _may_double(oscillation: Oscillation, largest: float | None) -> bool:
    """Return whether the command has room for a relay of twice the amplitude, and no smaller one was asked for."""
    limits, relay = oscillation.loop.envelope.settings, oscillation.settings
    room = min(relay.midpoint - limits.u_min, limits.u_max - relay.midpoint)
    return 2.0 * relay.amplitude <= min(largest or math.inf, 0.9 * room)
