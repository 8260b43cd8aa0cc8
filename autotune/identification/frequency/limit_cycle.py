"""Relay limit cycles in recorded arrays: switching instants, whole periods, convergence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.errors import IdentificationError

#: A two-level command explains at least this part of its own variance by two levels that move slowly.
_SQUARE_WAVE_PART = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class RelayEdges:
    """Switching instants of a two-level command.

    Attributes
    ----------
    times_s : (M,) array
        Instant of each switch [s]; a switch by way of one sample of intermediate command has the instant at
        which an ideal relay would have given the same area.
    rising : (M,) bool array
        Direction of each switch; directions alternate.
    jump : float
        Typical height of a switch, peak to peak of the relay [u unit].
    """

    times_s: FloatArray
    rising: BoolArray
    jump: float


@dataclass(frozen=True, kw_only=True)
class WholePeriods:
    """Window of whole periods between two switches of the same direction."""

    start_s: float
    end_s: float
    periods: int

    @property
    def period_s(self) -> float:
        """Mean period in the window [s]."""
        return (self.end_s - self.start_s) / self.periods

    @property
    def omega_rad_s(self) -> float:
        """Angular frequency of the fundamental, (22) of Le & Mendes 2010 [rad/s]."""
        return 2.0 * math.pi / self.period_s


def _switches(t: FloatArray, u: FloatArray, jump: float) -> tuple[FloatArray, BoolArray]:
    """Return instants and directions of the steps that reach 60 % of the jump within two samples."""
    step = np.diff(u)
    ahead = np.append(step[1:], 0.0)
    at_once = np.abs(step) >= 0.6 * jump
    by_way = ~at_once & (np.abs(step + ahead) >= 0.6 * jump) & (step * ahead > 0.0)
    rows = np.flatnonzero(at_once | by_way)
    if not rows.size:
        return t[:0], np.zeros(0, dtype=bool)
    rising = step[rows] > 0.0
    turns = np.flatnonzero(np.diff(rising)) + 1
    # steps before the first one back are the end of another relay's level, but for the last of them
    first = turns[0] - 1 if turns.size else rows.size - 1
    switches = np.concatenate([[first], turns])
    rows, rising = rows[switches], rising[switches]
    follows = np.where(step[rows] * ahead[rows] > 0.0, ahead[rows], 0.0)
    missing = follows / (step[rows] + follows)  # part of the whole switch that the row's own step leaves to the next
    return t[rows + 1] + missing * (t[np.minimum(rows + 2, t.size - 1)] - t[rows + 1]), rising


def relay_edges(t: FloatArray, u: FloatArray) -> RelayEdges:
    """Find the switches of a relay in the recorded command.

    Parameters
    ----------
    t : (N,) array
        Time stamps [s].
    u : (N,) array
        Command held from each stamp to the next; its mid-point may move slowly.

    Raises
    ------
    IdentificationError
        The command does not switch, or is not two-level.
    """
    increments = np.maximum(np.abs(np.diff(u)), np.abs(np.append(u[2:] - u[:-2], 0.0))) if u.size > 2 else np.zeros(1)
    largest = float(increments.max())
    scale = float(np.max(np.abs(u))) if u.size else 0.0
    if largest <= 1e-9 * max(scale, 1e-300):
        raise IdentificationError("the command never switches", where="limit cycle", remedy="record a relay experiment")
    jump = float(np.median(increments[increments > 0.5 * largest]))
    times, rising = _switches(t, u, jump)
    if times.size:
        settled = t >= times[0]
        # a row within which the command switched holds neither level
        settled[np.searchsorted(t, times[times > t[0]], side="right") - 1] = False
        level = np.where(np.searchsorted(times, t[settled], side="right") % 2 == 1, 1.0, -1.0)
        basis = np.column_stack([level, np.ones_like(level), t[settled] - t[-1]])
        left = u[settled] - basis @ np.linalg.lstsq(basis, u[settled], rcond=None)[0]
        apart = u[settled] - np.sum(u[settled]) / max(left.size, 1)  # no row is settled where u switches in every one
        if float(left @ left) > (1.0 - _SQUARE_WAVE_PART) * float(apart @ apart):
            raise IdentificationError(
                "the command is not a relay's: it has more than two levels",
                where="limit cycle",
                remedy="cut the segment to one relay setting, or use the estimate for other excitations",
            )
    return RelayEdges(times_s=times, rising=rising, jump=jump)


def whole_periods(edges: RelayEdges, end_s: float) -> WholePeriods:
    """Return the longest window of whole periods that ends by ``end_s``.

    Parameters
    ----------
    edges : RelayEdges
        The relay's switches.
    end_s : float
        Last time that counts [s].

    Raises
    ------
    IdentificationError
        Fewer than two whole periods.
    """
    best: WholePeriods | None = None
    for direction in (True, False):
        times = edges.times_s[(edges.rising == direction) & (edges.times_s <= end_s)]
        if times.size >= 3:
            window = WholePeriods(start_s=float(times[0]), end_s=float(times[-1]), periods=times.size - 1)
            if best is None or window.end_s - window.start_s > best.end_s - best.start_s:
                best = window
    if best is None:
        raise IdentificationError(
            f"{edges.times_s.size} switches make fewer than two whole periods",
            where="limit cycle",
            remedy="record at least two whole periods at one relay setting, better three",
        )
    return best
