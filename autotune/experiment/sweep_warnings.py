"""What the reader should know of a sweep's points: not as good as was wanted, or beyond what the link supports."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from autotune.config.procedure import ExperimentSettings
from autotune.experiment.result import Segment
from autotune.identification.sweep_estimate import SweepEstimate

#: residual of a limit cycle over that of the others (median) from which on it is said; under noise alone the largest of
#: 200 points was 1.05
UNEVEN = 1.1


def sweep_warnings(
    segments: Sequence[Segment],
    experiment: ExperimentSettings,
    link_rad_s: float,
    together: SweepEstimate | None = None,
) -> tuple[str, ...]:
    """Return what the reader should know of points not as good as was wanted, or beyond what the link supports.

    Parameters
    ----------
    segments : sequence of Segment
        The sweep's limit cycles.
    experiment : ExperimentSettings
        What was wanted.
    link_rad_s : float
        Highest frequency that the link supports [rad/s].
    together : SweepEstimate, optional
        The points from all rows, where they are the result.
    """
    wanted = experiment.gain_sd
    points = [one.point for one in segments] if together is None else together.points
    sds = [relative_sd(one) for one in segments] if together is None else [together.worst_sd]
    beyond = tuple(
        f"point at {omega:.3g} rad/s is beyond the {link_rad_s:.3g} rad/s that this link supports: its phase may be off"
        f" by {math.degrees(wanted * omega / link_rad_s):.2g} deg, use a link with less latency"
        for omega in (point.omega_rad_s for point in points)
        if omega > link_rad_s
    )
    coarse = [sd > 1.1 * wanted for sd in sds]
    if not any(coarse):
        return beyond
    enough_s = experiment.budget_s * (max(sds) / wanted) ** 2  # a variance falls as the time grows
    if together is not None:
        return (
            *beyond,
            f"points are known to {100 * max(sds):.2g} % at worst, {100 * wanted:.2g} % was wanted: set"
            f" experiment.budget_s = {float(f'{enough_s:.2g}'):g}",
        )
    residual = _over_others(segments)
    worst = max((i for i, one in enumerate(coarse) if one), key=lambda i: residual[i])
    at, first = segments[worst], ""
    if residual[worst] > UNEVEN:
        first = (
            f"look for an actuator at its limit, a load, or a start that had not settled at {at.start_s:.4g} to"
            f" {at.end_s:.4g} s, where y swings less evenly than elsewhere; else "
        )
    return (
        *beyond,
        f"{sum(coarse)} of {len(sds)} points are known to {100 * max(sds):.2g} % at worst, {100 * wanted:.2g} % was"
        f" wanted: {first}set experiment.budget_s = {float(f'{enough_s:.2g}'):g}",
    )


def _over_others(segments: Sequence[Segment]) -> list[float]:
    """Return every cycle's residual over the median of the others; 1 where there are too few to compare."""
    noise = np.array([one.noise_sd for one in segments])
    if noise.size < 3:
        return [1.0] * noise.size
    return [float(own / np.median(np.delete(noise, i))) for i, own in enumerate(noise)]


def relative_sd(segment: Segment) -> float:
    """Return the relative standard deviation of a limit cycle's point, of its gain and of its phase in radians."""
    return math.sqrt(float(np.trace(segment.point.covariance)) / 2.0) / segment.point.gain
