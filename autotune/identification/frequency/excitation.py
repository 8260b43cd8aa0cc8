"""What kind of experiment a recording holds: relay limit cycles, a repeated command, or any other excitation."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from autotune.errors import IdentificationError
from autotune.identification.frequency.limit_cycle import RelayEdges, relay_edges
from autotune.recording import Recording

#: Periods of one relay setting agree to this part.
_SAME_PERIOD = 0.15
_STEADY_PERIOD = 0.05
_LEAST_PERIODS = 3


def relay_segments(recording: Recording) -> tuple[tuple[float, float], ...]:
    """Return (start, end) [s] of the stretches in which a relay oscillates at one setting.

    The sidecar's ``relay`` tables are taken where there are any; else stretches of at least three periods that agree
    to 15 % are looked for in the command.
    """
    tables = recording.metadata.get("relay", ())
    if isinstance(tables, list) and tables and all(isinstance(table, Mapping) for table in tables):
        return _segments_of_sidecar(tables, recording)
    try:
        edges = relay_edges(recording.t, recording.u)
    except IdentificationError:
        return _segments_by_level(recording)
    return _regular_stretches(edges)


def _segments_of_sidecar(tables: list[Mapping[str, Any]], recording: Recording) -> tuple[tuple[float, float], ...]:
    margin = 2.5 * recording.sample_time_s  # the switch itself, which may take two rows
    return tuple(
        (float(table["start_s"]) - margin, float(table["end_s"]) + margin)
        for table in tables
        if "start_s" in table and "end_s" in table
    )


def _regular_stretches(edges: RelayEdges) -> tuple[tuple[float, float], ...]:
    """Return maximal runs of periods within 15 % of their neighbour, the periods at both ends that differ left out.

    From rise to rise; where those from fall to fall are not alike, steps of many lengths have come at regular times.
    """
    rises, falls = edges.times_s[edges.rising], edges.times_s[~edges.rising]
    periods = np.diff(rises)
    found = []
    first = 0
    for i in range(1, periods.size + 1):
        if i < periods.size and abs(periods[i] - periods[i - 1]) <= _SAME_PERIOD * periods[i - 1]:
            continue
        run = periods[first:i]
        steady = np.flatnonzero(np.abs(run - np.median(run)) <= _STEADY_PERIOD * np.median(run))
        if run.size >= _LEAST_PERIODS and steady.size:
            low, high = first + int(steady[0]), first + int(steady[-1]) + 1
            low += high - low > _LEAST_PERIODS  # the first period still settles
            high -= high - low > _LEAST_PERIODS  # the last one may already belong to another setting
            margin = 0.02 * float(np.median(run))
            between = np.diff(falls[(falls > rises[low]) & (falls < rises[high])])
            alike = np.all(np.abs(between - np.median(run)) <= _SAME_PERIOD * np.median(run))
            if high - low >= _LEAST_PERIODS - 1 and alike:
                found.append((float(rises[low]) - margin, float(rises[high]) + margin))
        first = i
    return tuple(found)


def _segments_by_level(recording: Recording) -> tuple[tuple[float, float], ...]:
    """Cut the record where the height of the switches changes, and look for relay oscillations in each part."""
    jumps = np.abs(np.diff(recording.u))
    big = np.flatnonzero(jumps > 0.02 * max(float(np.ptp(recording.u)), 1e-300))
    if big.size < 2 * _LEAST_PERIODS or big.size > 0.5 * jumps.size:
        return ()
    changes = np.flatnonzero(np.abs(np.diff(jumps[big])) > 0.1 * jumps[big][:-1])
    bounds = [0, *(int(big[i]) + 1 for i in changes), recording.t.size]
    found: list[tuple[float, float]] = []
    for low, high in pairwise(bounds):
        if high - low < 8 * _LEAST_PERIODS:
            continue
        try:
            edges = relay_edges(recording.t[low:high], recording.u[low:high])
        except IdentificationError:
            continue
        found.extend(_regular_stretches(edges))
    return tuple(found)


def repeat_length(recording: Recording) -> int | None:
    """Return the number of rows after which the command repeats itself exactly, None where it does not.

    At least two whole repeats are asked for, on uniform stamps, of a command that is not constant.
    """
    u = recording.u - recording.u.mean()
    n = u.size
    energy = float(u @ u)
    if not recording.is_uniform or energy <= 0.0 or n < 32:
        return None
    padded = np.fft.rfft(u, 2 * n)
    correlation = np.fft.irfft(np.abs(padded) ** 2, 2 * n)[: n // 2 + 1]
    expected = energy * (1.0 - np.arange(n // 2 + 1) / n)
    for lag in np.flatnonzero(correlation[8:] > 0.9 * expected[8:]) + 8:
        mismatch = u[lag:] - u[:-lag]
        if float(mismatch @ mismatch) < 1e-6 * energy:
            return int(lag)
    return None
