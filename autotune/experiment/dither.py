"""Dither on a rig under its present controller: a loop that must not be opened still tells what the plant is.

The present law runs on the host through the one control loop, within the safety envelope. A random binary signal with
random dwell times (flat over a wide band in log frequency) is added to its command, first small, then larger until y
departs from its operating point by about a third of the allowed swing or the dither takes a third of the room of u.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from autotune.arrays import FloatArray
from autotune.config import Config
from autotune.config.gains import beyond_ranges
from autotune.controller import PIDController
from autotune.design.law import LawState, PILaw
from autotune.errors import InputError
from autotune.experiment.limits import Watch
from autotune.experiment.loop import ControlLoop
from autotune.experiment.result import State, Status
from autotune.experiment.rig import HoldsGains, Rig
from autotune.experiment.run import OnStatus, bring_to_operating_point, envelope_of, recording_metadata, wait_for_rest
from autotune.experiment.verify import law_for
from autotune.recording import RecordingWriter

#: First dither, and the largest one, as shares of the command's room on its narrower side.
_FIRST, LARGEST_SHARE = 0.002, 0.33
#: Departure of y that is enough, as a share of the allowed swing.
LARGEST_DEPARTURE = 0.33
#: Largest change of the amplitude between two looks.
_GROWTH = 2.0
#: Departure at which the dither is halved at once, as a share of the allowed swing.
_ALARM = 0.55
#: Longest time the present law gets to bring y to rest before the dither begins, as a share of the experiment.
_SETTLE = 0.5
#: Looks at the departure within the experiment; the last half is run at one amplitude.
_LOOKS = 12
#: Shortest and longest dwell of the dither, in samples and as a share of the experiment.
_LONGEST_DWELL = 0.02


@dataclass(frozen=True, kw_only=True)
class DitherExperiment:
    """What was done on the rig.

    Attributes
    ----------
    recording : Path
        CSV with t, u, y, r (set-point) and dither (added to the controller's output).
    controller : PIDController
        Law that was in charge.
    amplitude : float
        Final half-amplitude of the dither [u unit].
    departure : float
        Largest departure of y from the set-point, beyond the noise [y unit].
    duration_s : float
        Time under dither [s].
    """

    recording: Path
    controller: PIDController
    amplitude: float
    departure: float
    duration_s: float


def _present_controller(rig: Rig, config: Config) -> PIDController:
    """Return the gains the loop has now: the configuration's, else those the open rig holds.

    Raises
    ------
    InputError
        Neither says, or the rig's are none that a rig of these ranges runs with.
    """
    if config.controller is not None:
        return PIDController(K=config.controller.K, Ti_s=config.controller.Ti_s)
    if isinstance(rig, HoldsGains):
        found = rig.read_gains()
        if odd := beyond_ranges(found.K, found.Ti_s, config.limits, config.signals.sample_time_s):
            raise InputError(
                f"the rig says that it holds gains of which {odd}",
                where="rig", remedy="check their registers with autotune probe, or write [controller] as it is now",
            )  # fmt: skip
        return found
    raise InputError(
        "the present controller is not known", where="[controller]", remedy="write K and Ti_s of the loop as it is now"
    )


def random_dwells(rows: int, longest: int, seed: int, shortest: int = 1) -> FloatArray:
    """Return a random binary signal of +-1, dwell times log-uniform from shortest to longest.

    Parameters
    ----------
    rows : int
        Length of the signal.
    longest : int
        Longest dwell [samples].
    seed : int
        Of the draws.
    shortest : int
        Shortest dwell [samples].

    Returns
    -------
    (rows,) array
        The signal.
    """
    rng = np.random.default_rng(seed)
    signal = np.empty(rows)
    at, sign = 0, 1.0
    while at < rows:
        dwell = max(1, round(float(shortest * (longest / shortest) ** rng.random())))
        signal[at : at + dwell] = sign
        at, sign = at + dwell, -sign
    return signal


def run_dither(
    rig: Rig,
    config: Config,
    recording: str | Path,
    *,
    duration_s: float | None = None,
    amplitude: float | None = None,
    dwell_s: tuple[float, float] | None = None,
    seed: int = 0,
    on_status: OnStatus | None = None,
) -> DitherExperiment:
    """Run the present law with a dither on a rig and leave the rig safe.

    Parameters
    ----------
    rig : Rig
        Closed.
    config : Config
        Limits, operating point, present controller.
    recording : path
        CSV to write.
    duration_s : float, optional
        Time under dither [s]; the experiment's budget when absent.
    amplitude : float, optional
        Half-amplitude [u unit]; found by the experiment when absent.
    dwell_s : (float, float), optional
        Shortest and longest dwell [s]; a sample and a fiftieth of the experiment when absent.
    seed : int
        Of the dither.
    on_status : callable, optional
        Told where the experiment is.

    Returns
    -------
    DitherExperiment

    Raises
    ------
    InputError
        The present controller is not known, the asked amplitude leaves the controller no room, or the dwell times are
        not in order.
    ExperimentStopped, LinkError, OperatorStop
        What ended it; the rig is safe and the recording readable.
    """
    duration_s = config.experiment.budget_s if duration_s is None else duration_s
    dt_s = config.signals.sample_time_s
    rows = math.ceil(duration_s / dt_s)
    shortest, longest = _dwell_rows(dwell_s, rows, dt_s)
    limits, centre = config.limits, config.operating_point.y
    writer = RecordingWriter(recording, ("t", "u", "y", "r", "dither"), recording_metadata(config))
    with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer, extra=("r", "dither")) as loop:
        controller = _present_controller(rig, config)
        u_hold = _bring_to_operating_point(loop, config)
        room = min(limits.u_max - u_hold, u_hold - limits.u_min)
        if amplitude is not None and not 0.0 < amplitude < 0.9 * room:
            raise InputError(
                f"amplitude = {amplitude:g}", where="dither", remedy=f"choose it above 0 and below {0.9 * room:.3g}"
            )
        largest = LARGEST_SHARE * room if amplitude is None else amplitude
        law = law_for(controller, limits, dt_s, largest)
        state = law.initial(u_hold, centre, centre)
        loop.watch = Watch(y_centre=centre, in_range=True)
        state = _settle(loop, law, state, centre, math.ceil(_SETTLE * rows))
        pattern = random_dwells(rows, longest, seed, shortest)
        now, departure, worst = _FIRST * room if amplitude is None else amplitude, 0.0, 0.0
        look, alarmed = max(1, rows // (2 * _LOOKS)), -rows
        for k in range(rows):
            tick = loop.tick
            if on_status is not None and k % max(1, round(0.5 / dt_s)) == 0:
                left_s, message = (rows - k) * dt_s, f"dither of {now:.3g} on the present loop"
                on_status(Status(state=State.SWEEP, elapsed_s=tick.t_s, remaining_s=left_s, message=message))
            away = max(0.0, abs(tick.y - centre) - loop.monitor.noise) if tick.usable else 0.0
            departure = max(departure, away)
            if amplitude is None and away > _ALARM * limits.swing and k - alarmed > look:
                now, alarmed = now / _GROWTH, k
            if amplitude is None and k and k % look == 0 and k <= rows // 2:
                now, departure, worst = _next(now, departure, limits.swing, largest), 0.0, max(worst, departure)
            u, state = law.step(state, centre, tick.y)
            added = now * pattern[k]
            sent = loop.nearest(u + added)
            loop.step(sent, extra={"r": centre, "dither": sent - u})
        loop.metadata["dither"] = {"amplitude": now, "seed": seed, "duration_s": rows * dt_s}
        loop.metadata["controller"] = {"kind": controller.kind, "K": controller.K, "Ti_s": controller.Ti_s}
    return DitherExperiment(
        recording=Path(recording),
        controller=controller,
        amplitude=now,
        departure=max(worst, departure),
        duration_s=rows * dt_s,
    )


def _dwell_rows(dwell_s: tuple[float, float] | None, rows: int, dt_s: float) -> tuple[int, int]:
    if dwell_s is None:
        return 1, max(2, round(_LONGEST_DWELL * rows))
    if not 0.0 < dwell_s[0] < dwell_s[1]:
        raise InputError(
            f"dwell times {dwell_s[0]:g} to {dwell_s[1]:g} s",
            where="dither",
            remedy="give the shortest, then the longest",
        )
    shortest = max(1, round(dwell_s[0] / dt_s))
    return shortest, max(shortest + 1, round(dwell_s[1] / dt_s))


def _settle(loop: ControlLoop, law: PILaw, state: LawState, centre: float, longest: int) -> LawState:
    """Run the present law without dither until y has stayed near the operating point, or for ``longest`` rows."""
    near, needed = 0, max(20, longest // 10)
    for _ in range(longest):
        tick = loop.tick
        u, state = law.step(state, centre, tick.y)
        loop.step(loop.nearest(u), extra={"r": centre, "dither": loop.nearest(u) - u})
        away = abs(tick.y - centre) - loop.monitor.noise
        near = near + 1 if away < 0.1 * loop.envelope.settings.swing else 0
        if near >= needed:
            break
    return state


def _next(amplitude: float, departure: float, swing: float, largest: float) -> float:
    """Return the amplitude for the next look, by the ratio of the wanted departure to the one seen."""
    ratio = LARGEST_DEPARTURE * swing / max(departure, 1e-9 * swing)
    return min(amplitude * min(max(ratio, 1.0 / _GROWTH), _GROWTH), largest)


def _bring_to_operating_point(loop: ControlLoop, config: Config) -> float:
    """Return the command that holds the plant there: measured on the way, or what the rig applies now."""
    if config.operating_point.approach == "ramp":
        wait_for_rest(loop)
        return bring_to_operating_point(loop, config).midpoint
    return loop.tick.u
