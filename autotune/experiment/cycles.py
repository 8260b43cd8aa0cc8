"""Points from finished limit cycles and the rows they were recorded in: the same on the rig and from the disk."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median_low

import numpy as np

from autotune.errors import InputError
from autotune.experiment.result import Cycle, Part, Segment
from autotune.identification.frequency.describing import describing_function
from autotune.identification.frequency.limit_cycle import WholePeriods
from autotune.identification.frequency.limit_cycle_points import LimitCycle
from autotune.identification.frequency.windows import Rows, Windowed, estimate_cycles
from autotune.points import FrequencyPoint
from autotune.recording import Recording, read_recording


def measure_cycle(cycle: Cycle, rows: Rows, sample_time_s: float, known: Sequence[FrequencyPoint]) -> Segment:
    """Return the cycle with its point.

    Parameters
    ----------
    cycle : Cycle
        Setting and window.
    rows : ((N,) array, (N,) array, (N,) array)
        t [s], u, y of the whole recording.
    sample_time_s : float
        Control period [s].
    known : sequence of FrequencyPoint
        Points of other cycles: they make the rough model of the plant better, and enter the estimate no further.

    Raises
    ------
    IdentificationError
        No response above the noise, or too few samples per period.
    """
    return _segment(cycle, _window(cycle, rows, sample_time_s).estimate(known), sample_time_s)


def _window(cycle: Cycle, rows: Rows, sample_time_s: float) -> Windowed:
    window = WholePeriods(start_s=cycle.start_s, end_s=cycle.end_s, periods=cycle.periods)
    return Windowed(rows=rows, window=window, sample_time_s=sample_time_s)


def _segment(cycle: Cycle, found: LimitCycle, sample_time_s: float) -> Segment:
    relay = cycle.settings
    delay_s = (relay.delay_samples + 0.5 * (relay.smoothing - 1)) * sample_time_s
    return Segment(
        part=cycle.part,
        phase_rad=cycle.phase_rad,
        settings=relay,
        start_s=found.start_s,
        end_s=found.end_s,
        periods=found.periods,
        delay_s=delay_s,
        point=found.points[0],
        harmonics=found.points[1:],
        describing=describing_function(found, delay_s),
        u_mean=found.u_mean,
        noise_sd=found.noise_sd,
        asymmetry=found.asymmetry,
    )


def noise_of(segments: Sequence[Segment]) -> float:
    """Return the standard deviation of the measurement noise [y unit]: what a cycle leaves that had settled.

    Parameters
    ----------
    segments : sequence of Segment
        One at least; of one that had not quite settled more than noise is left.
    """
    return median_low(one.noise_sd for one in segments)


def refine_cycles(
    segments: Sequence[Segment], rows: Callable[[int], Rows], sample_time_s: float
) -> tuple[Segment, ...]:
    """Return every cycle estimated once more from the recorded rows, now that the others make a better rough model.

    Parameters
    ----------
    segments : sequence of Segment
        As measured one after the other.
    rows : callable
        Returns t, u, y of a part's recording by its number.
    sample_time_s : float
        Control period [s].
    """
    found = estimate_cycles([_window(one, rows(one.part), sample_time_s) for one in segments])
    return tuple(_segment(one, cycle, sample_time_s) for one, cycle in zip(segments, found, strict=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class Earlier:
    """What the earlier sittings of an interrupted run left on the disk.

    Attributes
    ----------
    recordings : tuple of Recording
        In the order they were made; a segment's ``part`` counts them.
    segments : tuple of Segment
        Their finished limit cycles, points computed from the recorded rows.
    parts : tuple of Part
        What became of each sitting.
    """

    recordings: tuple[Recording, ...] = ()
    segments: tuple[Segment, ...] = ()
    parts: tuple[Part, ...] = ()

    @property
    def swept_s(self) -> float:
        """Rig time that the finished cycles took [s]."""
        return sum(one.end_s - one.start_s for one in self.segments)

    @property
    def u_rest(self) -> float | None:
        """Command that holds the operating point, as far as the finished cycles know it [u unit]."""
        return float(np.mean([one.u_mean for one in self.segments])) if self.segments else None

    def rows(self, part: int) -> Rows:
        """Return t, u, y of a part's recording."""
        recording = self.recordings[part]
        return recording.t, recording.u, recording.y


def read_earlier(paths: Sequence[Path], sample_time_s: float) -> Earlier:
    """Read interrupted recordings with their sidecars, and compute their points again.

    Parameters
    ----------
    paths : sequence of Path
        Recordings of one run, the oldest first; one that ended before its second row is passed over.
    sample_time_s : float
        Control period [s].

    Raises
    ------
    InputError
        A sidecar's relay table that is no finished limit cycle.
    """
    recordings: list[Recording] = []
    segments: list[Segment] = []
    parts: list[Part] = []
    for path in paths:
        if _lines(path) < 3:  # killed or out of space before its second row
            continue
        try:
            recording = read_recording(path)
        except InputError as error:
            if "two rows" in error.remedy:  # killed before its second row
                continue
            raise
        cycles = _read_finished(recording, len(recordings))
        for cycle in cycles:
            known = [one.point for one in segments]
            segments.append(measure_cycle(cycle, (recording.t, recording.u, recording.y), sample_time_s, known))
        first_move_s = float(recording.metadata.get("first_move_s", math.nan))
        parts.append(
            Part(
                recording=path.name,
                points=len(cycles),
                rig_time_s=float(recording.t[-1]),
                sweep_time_s=cycles[-1].end_s - first_move_s if cycles else 0.0,
                ended=_why(recording),
            )
        )
        recordings.append(recording)
    return Earlier(recordings=tuple(recordings), segments=tuple(segments), parts=tuple(parts))


def _lines(path: Path) -> int:
    try:
        with path.open("rb") as file:
            return sum(line.endswith(b"\n") for line in itertools.islice(file, 3))
    except OSError:
        return 3  # reading it says why it cannot be read


def _why(recording: Recording) -> str:
    ended = recording.metadata.get("ended", {})
    # only a loop that came to its end left an exit status
    return str(ended["reason"]) if "exit_status" in ended else "killed: nothing was written at the end"


def _read_finished(recording: Recording, part: int) -> list[Cycle]:
    tables = recording.metadata.get("relay", [])
    try:
        cycles = [Cycle.from_table(table, part) for table in tables]
        # a file that lost its end, on a disk that filled or at a power cut, lost the cycles there: they are run again
        return [cycle for cycle in cycles if cycle.end_s <= recording.t[-1] + recording.sample_time_s]
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            f"the sidecar's relay table lacks {error}", where=recording.name, remedy="begin a new run instead"
        ) from None
