"""Frequency points of any recording: relay, repeated command (multisine), random binary, steps; open or closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import is_constant
from autotune.distributions import chi2_tail
from autotune.errors import IdentificationError
from autotune.identification.answer import follows_in_row, require_answer
from autotune.identification.frequency.excitation import relay_segments
from autotune.identification.frequency.limit_cycle_points import limit_cycle_points
from autotune.identification.frequency.spectral_points import FrequencyEstimate, points_of_spectra
from autotune.identification.frequency.windows import estimate_cycles, read_noted_windows
from autotune.identification.sweep_noted import estimate_again, is_noted
from autotune.points import FrequencyPoint, as_pairs
from autotune.recording import Recording

_RELAY_PART = 0.5  # of the recording that relay oscillations must fill


def sessions(recordings: Sequence[Recording]) -> list[list[Recording]]:
    """Return the recordings in groups: those with an experiment's noted limit cycles together, every other alone."""
    noted = [one for one in recordings if read_noted_windows(one)]
    return ([noted] if noted else []) + [[one] for one in recordings if not read_noted_windows(one)]


def session_points(session: Sequence[Recording], *, largest_relative_sd: float = 0.5) -> FrequencyEstimate:
    """Estimate the plant's frequency response from recordings that belong together, see :func:`sessions`.

    Recordings whose sidecar notes limit cycles give the very points that the experiment ended with: the fundamentals,
    each with the others in its rough model, or those of all rows together: it has seen y answer, and few cycles say
    little of that. Parameters and errors as of :func:`frequency_points`.

    Parameters
    ----------
    session : sequence of Recording
        In the order in which they were made.
    largest_relative_sd : float
        Points with a larger standard deviation over their gain are left out.
    """
    last = read_noted_windows(session[-1])
    if is_noted(session[-1].metadata, len(last)):  # a sitting before it was not gone on with
        session = session[-1:]
    cycles = estimate_cycles([one for recording in session for one in read_noted_windows(recording)])
    if not cycles:
        return frequency_points(session[0], largest_relative_sd=largest_relative_sd)
    own = [cycle.points[0] for cycle in cycles]
    together = estimate_again(session[-1], own)
    if together is not None:
        return FrequencyEstimate(points=together.points, excitation="relay", cycles=cycles, fit=together.fit)
    points = sorted(own, key=lambda point: point.omega_rad_s)
    return FrequencyEstimate(points=tuple(points), excitation="relay", cycles=cycles)


def frequency_points(recording: Recording, *, largest_relative_sd: float = 0.5) -> FrequencyEstimate:
    """Estimate the plant's frequency response from a recording of whatever excitation it holds.

    Parameters
    ----------
    recording : Recording
        Columns t, u, y, and r where the loop was closed; y may have gaps.
    largest_relative_sd : float
        Points whose standard deviation is above this part of the gain (the rough model's, where there is one) are left
        out.

    Returns
    -------
    FrequencyEstimate
        Points with covariance.

    Raises
    ------
    IdentificationError
        The command or y never changes, y does not answer u beyond chance, too few rows, a broken measurement, or
        nothing above the noise; u follows y, and no set-point that moves u says how the plant answers.

    Notes
    -----
    Relay oscillations go to :func:`limit_cycle_points`. Anything else is estimated by local polynomials on the error
    of a rough model. Where r was recorded and moves the command, G = S_yr / S_ur: noise that the controller feeds back
    into u is correlated with u and would bias y over u towards -1/C; it is not correlated with r.
    """
    recording.require_finite(("u",))
    readings = recording.y[np.isfinite(recording.y)]
    if readings.size:  # how many are missing is said where they are bridged
        if is_constant(readings):
            raise IdentificationError(
                "y never changes", where=recording.name, remedy="record an experiment that moves u and y"
            )
        require_answer([recording])
    segments = relay_segments(recording)
    if sum(end - start for start, end in segments) >= _RELAY_PART * recording.duration_s or (
        segments and "relay" in recording.metadata
    ):
        return _of_relay(recording, segments, largest_relative_sd)
    estimate = points_of_spectra(recording, largest_relative_sd)
    if estimate.excitation in ("random or steps", "sines") and follows_in_row(recording):
        raise IdentificationError(
            "u and y move together within a row, as under a controller: y over u is then a mix of the plant and -1/C",
            where=recording.name,
            remedy="give the set-point that moved the loop as column r; or move u by hand, the controller off",
        )  # fmt: skip
    return estimate


def _of_relay(
    recording: Recording, segments: Sequence[tuple[float, float]], largest_relative_sd: float
) -> FrequencyEstimate:
    cycles, notes = [], []
    for start, end in segments:
        part = recording.between(start, end)
        try:
            cycle = limit_cycle_points(part.t, part.u, part.y, largest_relative_sd=min(0.1, largest_relative_sd))
        except IdentificationError as error:
            notes.append(f"relay from {start:.4g} s to {end:.4g} s left out: {error.what}")
            continue
        cycles.append(cycle)
        if cycle.outliers:
            notes.append(f"{cycle.outliers} wild or missing samples left out from {start:.4g} s to {end:.4g} s")
    points = sorted((point for cycle in cycles for point in cycle.points), key=lambda point: point.omega_rad_s)
    if not points:
        raise IdentificationError(
            "no relay oscillation gave a point", where=recording.name, remedy=notes[0] if notes else "record longer"
        )
    return FrequencyEstimate(points=tuple(points), excitation="relay", cycles=tuple(cycles), notes=tuple(notes))


def combine(estimates: Sequence[FrequencyEstimate]) -> FrequencyEstimate:
    """Merge the points of several recordings, weighted with their covariance, and test whether they agree.

    Parameters
    ----------
    estimates : sequence of FrequencyEstimate
        One per recording.

    Returns
    -------
    FrequencyEstimate
        Points within 1 % of the same frequency are merged; where the recordings contradict each other beyond chance
        (1 %), a note says so and the merged covariances are widened by the excess.
    """
    if len(estimates) == 1:
        return estimates[0]
    points = sorted((point for one in estimates for point in one.points), key=lambda point: point.omega_rad_s)
    groups: list[list[FrequencyPoint]] = []
    for point in points:
        if groups and point.omega_rad_s <= 1.01 * groups[-1][0].omega_rad_s:
            groups[-1].append(point)
        else:
            groups.append([point])
    merged = [_merge(group) for group in groups]
    chi_square = sum(one[1] for one in merged)
    freedom = sum(2 * (len(group) - 1) for group in groups)
    notes = tuple(note for one in estimates for note in one.notes)
    result = tuple(one[0] for one in merged)
    if freedom:
        notes, result = _judge(groups, result, chi_square, freedom, notes)
    return FrequencyEstimate(
        points=result,
        excitation=estimates[0].excitation,
        cycles=tuple(cycle for one in estimates for cycle in one.cycles),
        notes=notes,
    )


def _merge(group: Sequence[FrequencyPoint]) -> tuple[FrequencyPoint, float]:
    """Return the weighted mean of points at one frequency and the chi-square of their disagreement."""
    if len(group) == 1:
        return group[0], 0.0
    values = np.array([[point.response.real, point.response.imag] for point in group])
    floor = np.eye(2) * (1e-9 * group[0].gain) ** 2
    weights = np.array([np.linalg.inv(np.array(point.covariance) + floor) for point in group])
    covariance = np.linalg.inv(weights.sum(axis=0))
    mean = covariance @ np.einsum("nij,nj->i", weights, values)
    apart = values - mean
    omega = float(np.mean([point.omega_rad_s for point in group]))
    point = replace(
        group[0],
        omega_rad_s=omega,
        response=complex(mean[0], mean[1]),
        covariance=as_pairs(covariance),
    )
    return point, float(np.einsum("ni,nij,nj->", apart, weights, apart))


def _judge(
    groups: Sequence[Sequence[FrequencyPoint]],
    points: tuple[FrequencyPoint, ...],
    chi_square: float,
    freedom: int,
    notes: tuple[str, ...],
) -> tuple[tuple[str, ...], tuple[FrequencyPoint, ...]]:
    probability = chi2_tail(chi_square, freedom)
    shared = freedom // 2
    if probability > 0.01:
        note = f"the recordings agree where they share frequencies ({shared} comparisons, p = {probability:.2g})"
        return (*notes, note), points
    excess = chi_square / freedom
    widened = tuple(
        replace(point, covariance=as_pairs(excess * np.array(point.covariance))) if len(group) > 1 else point
        for point, group in zip(points, groups, strict=True)
    )
    note = (
        f"the recordings contradict each other (chi-square {chi_square:.4g} for {freedom} degrees of freedom):"
        f" the plant or its operating point changed; merged covariances were widened {excess:.3g} times"
    )
    return (*notes, note), widened
