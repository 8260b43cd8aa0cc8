"""What an experiment hands on: settings and times of every limit cycle, points, and what was learnt on the way."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from autotune.experiment.loop import Timing
from autotune.experiment.relay import RelaySettings
from autotune.identification.frequency.describing import DescribingFunctionEstimate
from autotune.points import FrequencyPoint


class State(StrEnum):
    """Where the procedure is; it goes through the states in this order and ends in the last from everywhere."""

    CONNECT = "connect"
    PREFLIGHT = "preflight"
    APPROACH = "approach"
    MIDPOINT = "find the mid-point"
    SWEEP = "relay sweep"
    HAND_BACK = "hand back"
    VERIFY = "verify"
    SAFE = "safe"


@dataclass(frozen=True, kw_only=True)
class Progress:
    """What a progress bar shows.

    Attributes
    ----------
    state : State
        Where the procedure is.
    elapsed_s, remaining_s : float
        Rig time gone, and expected to come; NaN while nobody can know.
    message : str
        What is happening, for a person.
    points : tuple of FrequencyPoint
        Points of the sweep measured so far.
    relay : RelaySettings or None
        The relay that runs.
    warnings : tuple of str
        What the reader should know, so far.
    """

    state: State
    elapsed_s: float
    remaining_s: float
    message: str
    points: tuple[FrequencyPoint, ...] = ()
    relay: RelaySettings | None = None
    warnings: tuple[str, ...] = ()

    @property
    def fraction(self) -> float:
        """Part of the expected rig time that is gone, 0 while nobody can know."""
        if not math.isfinite(self.remaining_s):
            return 0.0
        return min(1.0, self.elapsed_s / max(self.elapsed_s + self.remaining_s, 1e-9))


@dataclass(frozen=True, kw_only=True)
class Segment:
    """One settled limit cycle.

    Attributes
    ----------
    start_s, end_s : float
        Rows of the recording that the point was made from [s].
    settings : RelaySettings
        The relay.
    delay_s : float
        Inserted delay with the relay's smoothing, the T that was asked for [s].
    point : FrequencyPoint
        The Fourier ratio at the fundamental.
    harmonics : tuple of FrequencyPoint
        The odd harmonics that stand above the noise.
    describing : DescribingFunctionEstimate
        What formulas (20)-(22) say.
    periods : int
        Whole periods used.
    asymmetry : float
        Part of the period with the high command, less one half.
    """

    start_s: float
    end_s: float
    settings: RelaySettings
    delay_s: float
    point: FrequencyPoint
    harmonics: tuple[FrequencyPoint, ...]
    describing: DescribingFunctionEstimate
    periods: int
    asymmetry: float

    def metadata(self) -> dict[str, Any]:
        """Return the segment as a table of the recording's sidecar."""
        relay = self.settings
        return {
            "start_s": self.start_s,
            "end_s": self.end_s,
            "delay_s": self.delay_s,
            "amplitude": relay.amplitude,
            "hysteresis": relay.hysteresis,
            "midpoint": relay.midpoint,
            "smoothing": relay.smoothing,
            "plant_sign": relay.plant_sign,
        }


@dataclass(frozen=True, kw_only=True)
class ExperimentResult:
    """What a finished experiment knows.

    Attributes
    ----------
    segments : tuple of Segment
        One per point, in the order they were measured.
    points : tuple of FrequencyPoint
        The fundamentals, ascending in frequency.
    plant_sign : int
        Sign of the plant's gain.
    u_rest, u_rest_sd : float
        Command that holds the operating point, and its standard deviation [u unit].
    noise_sd : float
        Standard deviation of the measurement noise [y unit].
    timing : Timing
        Latency and lateness of the loop.
    rig_time_s : float
        Time on the rig [s].
    first_move_s : float
        When the plant first answered (the ball first floated) [s].
    sweep_time_s : float
        From then to the end of the last point [s].
    reason : str
        Why it ended.
    warnings : tuple of str
        What the reader should know.
    """

    segments: tuple[Segment, ...]
    points: tuple[FrequencyPoint, ...]
    plant_sign: int
    u_rest: float
    u_rest_sd: float
    noise_sd: float
    timing: Timing
    rig_time_s: float
    first_move_s: float
    sweep_time_s: float
    reason: str
    warnings: tuple[str, ...]
