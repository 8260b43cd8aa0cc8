"""Many frequency points thinned to few, with their information kept: neighbours averaged by what each of them says.

A spectrum may hold a hundred thousand points, and a design weighs each against each. Within a narrow band a response
is a straight line in frequency, so that the mean of its points, weighted by their inverse covariances and stated at
their weighted mean frequency, says all that they say together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.points import FrequencyPoint, as_pairs

#: Points that a reduction or a design works on; the work grows with their square.
MOST = 240


def thin_points(points: Sequence[FrequencyPoint], most: int = MOST) -> tuple[FrequencyPoint, ...]:
    """Return at most so many points, in ascending frequency; fewer than that are returned as they are.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Estimates whose errors are independent.
    most : int
        Most points to return.

    Returns
    -------
    tuple of FrequencyPoint
        One for each of ``most`` bands of equal width in log frequency that holds points. Its covariance is the inverse
        of the sum of the points' inverses, widened by their reduced chi-square about the mean where that exceeds one:
        a band in which the response bends more than its points are uncertain says so.

    Notes
    -----
    The mean is unbiased to first order in the band's width; the second order, a resonance narrower than a band, is in
    the widened covariance.
    """
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    if len(ordered) <= most:
        return tuple(ordered)
    omega = np.array([point.omega_rad_s for point in ordered])
    response = np.array([point.response for point in ordered])
    covariance = np.array([point.covariance for point in ordered])
    edges = np.geomspace(omega[0], omega[-1], most + 1)
    band = np.clip(np.searchsorted(edges, omega, side="right") - 1, 0, most - 1)
    cuts = np.flatnonzero(np.diff(band)) + 1
    groups = np.split(np.arange(omega.size), cuts)
    return tuple(_mean(omega[at], response[at], covariance[at], ordered[int(at[0])]) for at in groups)


def _mean(omega: FloatArray, response: ComplexArray, covariance: FloatArray, first: FrequencyPoint) -> FrequencyPoint:
    if omega.size == 1:
        return first
    # a point that is said to be known exactly must not outweigh all others beyond what arithmetic holds
    floor = 1e-12 * np.abs(response) ** 2
    information = np.linalg.inv(covariance + floor[:, None, None] * np.eye(2))
    total = np.linalg.inv(information.sum(axis=0))
    values = np.column_stack([response.real, response.imag])
    mean = total @ np.einsum("kij,kj->i", information, values)
    weight = np.einsum("kii->k", information)
    centre = float(np.sum(weight * omega) / np.sum(weight))
    # what a straight line through the band explains is no contradiction between its points
    slope = np.sum(weight[:, None] * (omega - centre)[:, None] * (values - mean), axis=0)
    spread = float(np.sum(weight * (omega - centre) ** 2))
    residual = values - mean - np.outer(omega - centre, slope / spread if spread > 0.0 else np.zeros(2))
    freedom = max(2 * omega.size - 4, 1)
    chi_square = float(np.einsum("ki,kij,kj->", residual, information, residual)) / freedom
    wide = total * max(1.0, chi_square)
    return FrequencyPoint(
        omega_rad_s=centre,
        response=complex(mean[0], mean[1]),
        covariance=as_pairs(wide),
        source=first.source,
    )


def thinning_note(given: int, kept: int) -> tuple[str, ...]:
    """Return a note that points were thinned, none where they were not.

    Parameters
    ----------
    given, kept : int
        Numbers of points before and after.
    """
    return (f"{given} points were averaged in {kept} bands, with their information kept",) if kept < given else ()
