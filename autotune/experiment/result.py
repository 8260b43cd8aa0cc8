"""What an experiment hands on: settings and times of every limit cycle, points, and what was learnt on the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from typing import Any

from autotune.experiment.leaving import SAFE
from autotune.experiment.loop import Timing
from autotune.experiment.relay import RelaySettings
from autotune.identification.frequency.describing import DescribingFunctionEstimate
from autotune.identification.sweep_estimate import SweepEstimate
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
class Status:
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
class Cycle:
    """One finished limit cycle: what was set, and which rows of which recording hold it.

    Attributes
    ----------
    part : int
        Number of the recording that holds it, 0 for the first; more than one where a run was resumed.
    phase_rad : float
        Phase of the positive-gain plant that it aimed at [rad].
    settings : RelaySettings
        The relay.
    start_s, end_s : float
        Window of whole periods, in the recording's time [s].
    periods : int
        Whole periods in it.
    """

    part: int
    phase_rad: float
    settings: RelaySettings
    start_s: float
    end_s: float
    periods: int

    def to_table(self) -> dict[str, Any]:
        """Return the cycle as a table of the recording's sidecar."""
        own = {key: getattr(self, key) for key in ("phase_rad", "start_s", "end_s", "periods")}
        return own | asdict(self.settings)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], part: int) -> Cycle:
        """Return the cycle that :meth:`to_table` wrote.

        Parameters
        ----------
        table : mapping
            From the recording's sidecar.
        part : int
            Which recording of the run it is in.

        Raises
        ------
        KeyError
            One of its keys is missing.
        """
        return cls(
            part=part,
            settings=RelaySettings(**{field.name: table[field.name] for field in fields(RelaySettings)}),
            **{key: table[key] for key in ("phase_rad", "start_s", "end_s", "periods")},
        )


@dataclass(frozen=True, kw_only=True)
class Segment(Cycle):
    """A finished limit cycle with the point that was made from it.

    Attributes
    ----------
    delay_s : float
        Inserted delay with the relay's smoothing, the T that was asked for [s].
    point : FrequencyPoint
        The Fourier ratio at the fundamental.
    harmonics : tuple of FrequencyPoint
        The odd harmonics that stand above the noise.
    describing : DescribingFunctionEstimate
        What formulas (20)-(22) say.
    u_mean, noise_sd : float
        Mean command [u unit]; standard deviation of the measurement noise [y unit].
    asymmetry : float
        Part of the period with the high command, less one half.
    """

    delay_s: float
    point: FrequencyPoint
    harmonics: tuple[FrequencyPoint, ...]
    describing: DescribingFunctionEstimate
    u_mean: float
    noise_sd: float
    asymmetry: float


@dataclass(frozen=True, kw_only=True)
class Part:
    """One sitting at the rig; a run that was never interrupted has one.

    Attributes
    ----------
    recording : str
        Name of its file.
    points : int
        Points finished in it.
    rig_time_s, sweep_time_s : float
        Its time on the rig, and from the plant's first answer to its last point [s].
    ended : str
        Why it ended.
    """

    recording: str
    points: int
    rig_time_s: float
    sweep_time_s: float
    ended: str


@dataclass(frozen=True, kw_only=True)
class ExperimentResult:
    """What a finished experiment knows.

    Attributes
    ----------
    segments : tuple of Segment
        The limit cycles, in the order they were measured.
    points : tuple of FrequencyPoint
        From all rows together where those allow it, else the cycles' fundamentals; ascending in frequency.
    plant_sign : int
        Sign of the plant's gain.
    u_rest, u_rest_sd : float
        Command that holds the operating point, and its standard deviation [u unit].
    noise_sd : float
        Standard deviation of the measurement noise [y unit].
    timing : Timing
        Latency and lateness of the loop.
    rig_time_s : float
        Time on the rig, all sittings together [s].
    first_move_s : float
        When the plant first answered (the ball first floated), in the last recording [s].
    sweep_time_s : float
        From the plant's first answer to the last point, all sittings together [s].
    parts : tuple of Part
        The sittings.
    reason : str
        Why it ended.
    warnings : tuple of str
        What the reader should know.
    output : str
        Who moves the actuator since, as the rig confirmed it.
    together : SweepEstimate or None
        What gave the points, where all rows together did.
    by_itself : str
        Why each point is of its own limit cycle, where estimating them together was tried.
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
    parts: tuple[Part, ...]
    reason: str
    warnings: tuple[str, ...]
    output: str = SAFE
    together: SweepEstimate | None = None
    by_itself: str = ""
