"""Excitations that tell hypotheses apart, and their run on a rig within the safety envelope.

A pattern is added to the set-point or to the command of the present control law, or to a held command where there is no
law; the one control loop runs it, and halves it where y comes near the limits.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.config import Config
from autotune.controller import PIDController
from autotune.design.law import LawState, PILaw
from autotune.experiment.approach import approach, find_midpoint
from autotune.experiment.limits import Watch
from autotune.experiment.loop import ControlLoop, Tick
from autotune.experiment.preflight import preflight, silent
from autotune.experiment.result import State, Status
from autotune.experiment.rig import Rig
from autotune.experiment.run import OnStatus, envelope_of, recording_metadata, wait_for_rest
from autotune.experiment.verify import law_for
from autotune.recording import Recording, RecordingWriter, read_recording

Kind: TypeAlias = Literal["staircase", "triangle", "random steps", "sweep", "pulses"]
On: TypeAlias = Literal["set-point", "command"]
KINDS: tuple[Kind, ...] = ("staircase", "triangle", "random steps", "sweep", "pulses")
#: Levels of a staircase: up, down through the middle, and back, so that every level is met in both directions.
LEVELS = (0.0, 0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5)
#: Departure of y at which the pattern is halved, as a share of the allowed swing.
ALARM = 0.65
#: Longest wait for rest before the pattern begins, in its slowest feature; departure that counts as rest, of the swing.
SETTLE, AT_REST = 6.0, 0.1


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """What is to be done on the rig.

    Attributes
    ----------
    kind : str
        ``staircase``, ``triangle``, ``random steps``, ``sweep`` or ``pulses``.
    on : {"set-point", "command"}
        What the pattern is added to.
    amplitude : float
        Its largest departure [y unit or u unit].
    hold_s : float
        Its slowest feature: dwell of a staircase, quarter period of a triangle, longest dwell of random steps, quarter
        of a sweep's longest period, pause between pulses [s].
    duration_s : float
        Time under excitation [s].
    seed : int
        Of random steps.
    """

    kind: Kind
    on: On
    amplitude: float
    hold_s: float
    duration_s: float
    seed: int = 0

    def settings(self) -> dict[str, Any]:
        """Return the settings as a table, without the kind."""
        return {key: value for key, value in asdict(self).items() if key != "kind"}

    def pattern(self, sample_time_s: float) -> FloatArray:
        """Return the pattern, (rows,), in the unit of what it is added to."""
        rows = math.ceil(self.duration_s / sample_time_s)
        hold = max(2, round(self.hold_s / sample_time_s))
        k = np.arange(rows)
        match self.kind:
            case "staircase":
                shape = np.array(LEVELS)[k // hold % len(LEVELS)]
            case "triangle":
                shape = 2.0 / math.pi * np.arcsin(np.sin(0.5 * math.pi * k / hold))
            case "random steps":
                shape = _random_steps(rows, hold, self.seed)
            case "sweep":
                shape = _sweep(rows, hold)
            case "pulses":
                shape = _pulses(rows, hold)
        return np.asarray(self.amplitude * shape)


def _random_steps(rows: int, longest: int, seed: int) -> FloatArray:
    """Return levels drawn evenly from -1 to 1, dwell times log-uniform from two samples to the longest."""
    random = np.random.default_rng(seed)
    signal, at = np.empty(rows), 0
    while at < rows:
        dwell = max(2, round(float(2.0 * (longest / 2.0) ** random.random())))
        signal[at : at + dwell] = random.uniform(-1.0, 1.0)
        at += dwell
    return signal


def _sweep(rows: int, hold: int) -> FloatArray:
    """Return a sine whose period shrinks geometrically from four holds to a tenth of one, at least eight samples."""
    first, last = 1.0 / (4.0 * hold), min(1.0 / 8.0, 10.0 / hold)
    k, ratio = np.arange(rows), math.log(max(last / first, 1.0 + 1e-9))
    return np.asarray(np.sin(2.0 * math.pi * first * rows / ratio * (np.exp(ratio * k / rows) - 1.0)))


def _pulses(rows: int, hold: int) -> FloatArray:
    """Return pulses of growing size and alternating sign, each an eighth of a hold long, a hold apart."""
    signal, width = np.zeros(rows), max(1, hold // 8)
    for number, at in enumerate(range(0, rows, hold)):
        size = (1 + number // 2 % 4) / 4.0
        signal[at : at + width] = size if number % 2 == 0 else -size
    return signal


def run_excitation(
    rig: Rig, config: Config, recording: str | Path, excitation: Excitation, *, on_status: OnStatus | None = None
) -> Recording:
    """Run an excitation on a rig around its operating point and leave the rig safe.

    Parameters
    ----------
    rig : Rig
        Closed.
    config : Config
        Limits, operating point, and the present control law where there is one.
    recording : path
        CSV to write: t, u, y, r and what was added to the command, from the first sample on.
    excitation : Excitation
        What to do.
    on_status : callable, optional
        Told where the experiment is.

    Returns
    -------
    Recording
        The rows under excitation; the file has those before too.

    Raises
    ------
    ExperimentStopped, LinkError, OperatorStop
        What ended it; the rig is safe and the recording readable.
    """
    limits, dt_s = config.limits, config.signals.sample_time_s
    pattern = excitation.pattern(dt_s)
    writer = RecordingWriter(recording, ("t", "u", "y", "r", "dither"), recording_metadata(config))
    with ControlLoop(rig=rig, envelope=envelope_of(config), writer=writer, extra=("r", "dither")) as loop:
        loop.note(excitation={"kind": excitation.kind} | excitation.settings())
        u_hold = _brought_there(loop, config)
        drive = _Drive(loop, config, u_hold, excitation.amplitude if excitation.on == "command" else 0.0)
        drive.settle(excitation.hold_s)
        # until here a plant that was left at its safe output may still have been on its way
        loop.watch = Watch(y_centre=config.operating_point.y, in_range=True)
        start_s, share, alarmed_s = loop.tick.t_s, 1.0, -math.inf
        for k, wanted in enumerate(pattern):
            tick = loop.tick
            if on_status is not None and k % max(1, round(0.5 / dt_s)) == 0:
                left_s = (pattern.size - k) * dt_s
                on_status(Status(state=State.SWEEP, elapsed_s=tick.t_s, remaining_s=left_s,
                                     message=f"{excitation.kind} on the {excitation.on}"))  # fmt: skip
            if drive.away(tick) > ALARM * limits.swing and tick.t_s - alarmed_s > 0.25 * excitation.hold_s:
                share, alarmed_s = 0.5 * share, tick.t_s
            drive.step(share * float(wanted), on_setpoint=excitation.on == "set-point")
        loop.metadata["excitation"] |= {"start_s": start_s, "end_s": loop.tick.t_s, "share_at_end": share}
        if config.controller is not None:
            # not as [controller]: the loop ran this law itself, there is no other's law to be checked
            loop.metadata["law"] = {"kind": "pi", "K": config.controller.K, "Ti_s": config.controller.Ti_s}
        end_s = loop.tick.t_s
    # stamps in the file are rounded: half a sample to either side
    return read_recording(recording).between(start_s - 0.5 * dt_s, end_s - 0.5 * dt_s)


def _brought_there(loop: ControlLoop, config: Config) -> float:
    """Bring the plant to its operating point, slowly moving, and return the command that is believed to hold it."""
    point, wanted = config.operating_point, config.experiment
    if point.approach == "ramp":
        wait_for_rest(loop)
    known = preflight(loop, point, wanted.gain_sd, silent)
    if point.approach == "hold":
        return point.u_guess
    known = approach(loop, point, known, silent)
    known, oscillation = find_midpoint(loop, point, wanted.relay_amplitude, known, silent)
    # y turns midway between two switches: handed over there, a slow law does not have to stop a plant in full swing
    half = float(np.median(np.diff(oscillation.edges[-5:]))) if len(oscillation.edges) > 1 else 0.0
    while not oscillation.step()[1]:
        pass
    for _ in range(round(0.5 * half)):
        oscillation.step()
    return known.midpoint


class _Drive:
    """The present control law around the operating point, or a held command where the configuration states none."""

    def __init__(self, loop: ControlLoop, config: Config, u_hold: float, reserve: float) -> None:
        self._loop, self._swing = loop, config.limits.swing
        self._centre, self._u_hold = config.operating_point.y, u_hold
        self._law: PILaw | None = None
        self._state: LawState | None = None
        if config.controller is not None:
            present = PIDController(K=config.controller.K, Ti_s=config.controller.Ti_s)
            self._law = law_for(present, config.limits, config.signals.sample_time_s, reserve)
            self._state = self._law.initial(u_hold, self._centre, self._centre)

    def away(self, tick: Tick) -> float:
        """Return how far y is from the operating point, beyond the noise [y unit]."""
        return max(0.0, abs(tick.y - self._centre) - self._loop.monitor.noise) if tick.usable else 0.0

    def step(self, added: float, *, on_setpoint: bool) -> None:
        """Take one sample with something added to the set-point or to the command."""
        loop, r = self._loop, self._centre + (added if on_setpoint else 0.0)
        u = self._u_hold
        if self._law is not None and self._state is not None:
            u, self._state = self._law.step(self._state, r, loop.tick.y)
        sent = loop.nearest(u + (0.0 if on_setpoint else added))
        loop.step(sent, extra={"r": r, "dither": sent - u})

    def settle(self, slowest_s: float) -> None:
        """Wait until y has stayed near the operating point, or no longer moves where nothing holds it there."""
        rows = math.ceil(SETTLE * slowest_s / self._loop.sample_time_s)
        needed, near, before = max(20, rows // 12), 0, self._loop.tick.y
        for k in range(rows):
            self.step(0.0, on_setpoint=True)
            tick = self._loop.tick
            if self._law is None and k % needed == 0:
                still, before = abs(tick.y - before) < AT_REST * self._swing + self._loop.monitor.noise, tick.y
                if still and k > needed:
                    return
            near = near + 1 if self.away(tick) < AT_REST * self._swing else 0
            if near >= needed and self._law is not None:
                return
