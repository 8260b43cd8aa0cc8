"""Gaps of a record: samples that were lost here and there are bridged, and longer gaps cut it into stretches.

The command is known over a gap, it was held; only the measurement is missing. A few missing values among many are put
in between their neighbours, which is an error of the size of the noise in those rows and in no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from autotune.arrays import BoolArray, IntArray
from autotune.errors import IdentificationError
from autotune.recording import Recording

#: time stamps may stray this far from the grid, as a share of the sample time
JITTER = 0.25
#: fewest rows a closed-loop identification accepts
FEWEST_ROWS = 60
#: longest gap that is bridged, in samples, and the largest share of rows that may be put in
LONGEST, SHARE = 3, 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Bridged:
    """A record with its short gaps bridged.

    Attributes
    ----------
    recording : Recording
        Equidistant over the gaps that were bridged.
    gaps, rows : int
        How many were, and how many measurements were put in.
    """

    recording: Recording
    gaps: int
    rows: int


def bridge_gaps(recording: Recording, jitter: float) -> Bridged:
    """Return the record with up to three missing samples in a row put in, where they are few.

    Parameters
    ----------
    recording : Recording
        With gaps of its stamps, or rows without a measurement.
    jitter : float
        How far a stamp may stray from the grid, as a share of the sample time; a row that strays further came late and
        counts as missing, its command acts from its time on.

    Returns
    -------
    Bridged
        The record as it was where there are no such gaps, or so many that what is put in would speak for the plant.

    Notes
    -----
    ``u`` is the mean of the command over each sample time, exactly; ``y`` is interpolated linearly, further columns are
    held. The error of an interpolated value is about the noise and the movement of y within the gap: with 5 % of such
    rows the estimate's noise grows by as much, and what is said of its accuracy stays within that.
    """
    kept, slots = _on_grid(recording, jitter)
    lengths = np.diff(slots)
    short = (lengths > 1) & (lengths <= LONGEST + 1)
    put_in = int(np.sum(lengths[short] - 1))
    if put_in == 0 or put_in > SHARE * len(recording):
        return Bridged(recording=recording, gaps=0, rows=0)
    whole = _fill(recording, kept, np.where(short, lengths, 1))
    return Bridged(recording=whole, gaps=int(short.sum()), rows=put_in)


def _on_grid(recording: Recording, jitter: float) -> tuple[IntArray, IntArray]:
    """Return the rows with a measurement that stand on the grid of their predecessor, and their numbers on it."""
    T_s = recording.sample_time_s
    t, measured = recording.t, np.flatnonzero(np.isfinite(recording.y))
    steps = np.diff(t) / T_s
    if measured.size == 0 or (measured.size == t.size and np.all(np.abs(steps - 1.0) <= jitter)):
        return np.arange(t.size), np.arange(t.size)
    kept, slots = [int(measured[0])], [0]
    for row in measured[1:].tolist():
        step = (t[row] - t[kept[-1]]) / T_s
        whole = round(step)
        is_near = whole <= LONGEST + 1
        if is_near and (abs(step - whole) > jitter or whole == 0):
            continue  # it came late, or twice: missing on the grid
        kept.append(row)
        slots.append(slots[-1] + (whole if is_near else LONGEST + 2))  # a long gap stays one
    return np.array(kept), np.array(slots)


def _fill(recording: Recording, kept: IntArray, lengths: IntArray) -> Recording:
    t, T_s = recording.t, recording.sample_time_s
    first = np.concatenate(([0], np.cumsum(lengths)))
    rows = np.arange(int(first[-1]) + 1)
    put_in = np.ones(rows.size, dtype=bool)
    put_in[first] = False
    at = np.interp(rows, first, t[kept])
    source = kept[np.searchsorted(first, rows, side="right") - 1]
    y, u = recording.y[source].copy(), recording.u[source].copy()
    usable = ~put_in & np.isfinite(y)
    y[put_in] = np.interp(at[put_in], at[usable], y[usable])
    # the mean of what was held, where a row was put in and where one that came late was left out
    area = np.concatenate(([0.0], np.cumsum(recording.u[:-1] * np.diff(t))))
    late = np.setdiff1d(np.arange(t.size), kept)
    changed = put_in.copy()
    changed[np.searchsorted(at, t[late], side="right") - 1] = True
    changed[-1] = False
    start, end = at[changed], np.minimum(at[changed] + T_s, t[-1])
    u[changed] = (np.interp(end, t, area) - np.interp(start, t, area)) / (end - start)
    extra = {name: values[source] for name, values in recording.extra.items()}
    return replace(recording, t=at, u=u, y=y, extra=MappingProxyType(extra))


def usable_stretch(recording: Recording) -> tuple[Recording, tuple[str, ...]]:
    """Return the longest of the :func:`usable_stretches`, and what was left out.

    Raises
    ------
    IdentificationError
        It is shorter than 60 rows; names what cuts the recording.
    """
    whole, good, broken = _examine(recording)
    rows = max(_pieces(good, broken), key=len, default=np.arange(0))
    _require(len(rows), good, broken, recording.name)
    return _between(whole.recording, rows), _changes_text(recording, whole, [rows])


def usable_stretches(recording: Recording, shortest: int) -> tuple[tuple[Recording, ...], tuple[str, ...]]:
    """Return the stretches of equidistant rows in which u, y, r and dither are numbers, and what was left out.

    Gaps of up to three samples are bridged where they are few.

    Parameters
    ----------
    recording : Recording
        As a rig left it: unusable samples, missed deadlines, a start-up without set-point.
    shortest : int
        Fewest rows of a stretch beside the longest.

    Returns
    -------
    stretches : tuple of Recording
        In their order; at least 60 rows in all.
    warnings : tuple of str
        Which rows were left out, and time stamps that stray.

    Raises
    ------
    IdentificationError
        There are not enough rows; names what cuts the recording.
    """
    whole, good, broken = _examine(recording)
    pieces = _pieces(good, broken)
    pieces = [rows for rows in pieces if len(rows) >= shortest] or [max(pieces, key=len, default=np.arange(0))]
    _require(sum(map(len, pieces)), good, broken, recording.name)
    warnings = _changes_text(recording, whole, pieces)
    if len(pieces) > 1:
        warnings = (f"{len(pieces)} stretches between gaps are used together", *warnings)
    return tuple(_between(whole.recording, piece) for piece in pieces), warnings


def _examine(recording: Recording) -> tuple[Bridged, BoolArray, BoolArray]:
    """Return the bridged record, which of its rows hold numbers, and after which of them time jumps."""
    whole = bridge_gaps(recording, JITTER)
    columns = [whole.recording.u, whole.recording.y]
    columns += [c for name, c in whole.recording.extra.items() if name in ("r", "dither") and np.isfinite(c).any()]
    good = np.all([np.isfinite(column) for column in columns], axis=0)
    broken = np.abs(np.diff(whole.recording.t) / whole.recording.sample_time_s - 1.0) > JITTER
    return whole, good, broken


def _pieces(good: BoolArray, broken: BoolArray) -> list[IntArray]:
    """Return the rows of each stretch."""
    ends = np.flatnonzero(broken | (good[1:] != good[:-1])) + 1
    return [rows for rows in np.split(np.arange(good.size), ends) if rows.size and good[rows[0]]]


def _require(rows: int, good: BoolArray, broken: BoolArray, where: str) -> None:
    if rows >= FEWEST_ROWS:
        return
    reasons = f"{int((~good).sum())} rows hold values that are not numbers, time jumps {int(broken.sum())} times"
    cut = "" if rows == len(good) else f" in one piece ({reasons})"
    raise IdentificationError(
        f"the record is too short: {rows} equidistant rows{cut}",
        where=where,
        remedy=f"record at least {FEWEST_ROWS} rows, better a thousand, with the set-point or a dither moving",
    )


def _between(recording: Recording, rows: IntArray) -> Recording:
    if len(rows) == len(recording):
        return recording
    return recording.between(float(recording.t[rows[0]]), float(recording.t[rows[-1]]) + 0.5 * recording.sample_time_s)


def _changes_text(recording: Recording, whole: Bridged, pieces: Sequence[IntArray]) -> tuple[str, ...]:
    """Return what was put in and left out of the record as it was given, and time stamps that stray."""
    t, T_s, warnings = whole.recording.t, recording.sample_time_s, []
    if whole.gaps:
        warnings.append(f"{whole.gaps} gap(s) of up to three samples were bridged: {whole.rows} of {len(t)} rows")
    spans = [(t[rows[0]] - 0.5 * T_s, t[rows[-1]] + 0.5 * T_s) for rows in pieces]
    used = np.any([(recording.t >= a) & (recording.t <= b) for a, b in spans], axis=0)
    spared = used[:-1].all()  # a rig's last row holds the safe command and nothing else
    if not spared:
        share = f"{int(used.sum())} of {used.size} rows"
        first, last = t[pieces[0][0]], t[pieces[-1][-1]]
        said = f"only t = {first:g} to {last:g} s is used ({share}): outside"
        said = said if len(pieces) == 1 else f"{share} are used: elsewhere"
        warnings.append(f"{said}, values are not numbers or time stamps are not equidistant")
    stray = max(float(np.max(np.abs(np.diff(t[rows]) / T_s - 1.0), initial=0.0)) for rows in pieces)
    if stray > 0.01:
        warnings.append(f"time stamps stray by up to {100 * stray:.2g} % of the sample time")
    return tuple(warnings)
