"""Frequency points: the complex gain of the plant at one frequency, with its covariance."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from autotune.arrays import FloatArray, is_real
from autotune.errors import InputError
from autotune.text_files import read_json

#: Most points of a file; they are thinned before a design, see identification.frequency.thinning.
MOST_POINTS = 200_000
#: Range of frequencies [rad/s] and gains, far beyond every unit and far from where arithmetic overflows.
SMALLEST, LARGEST = 1e-30, 1e30
LARGEST_PHASE_DEG = 1e6
#: Relative precision of arithmetic, and relative distance within which two frequencies are one.
_PRECISION, _SAME = 1e-15, 1e-3


@dataclass(frozen=True, kw_only=True)
class FrequencyPoint:
    """An estimate of G(j omega) and how well it is known.

    Attributes
    ----------
    omega_rad_s : float
        Angular frequency [rad/s].
    response : complex
        Estimated complex gain, output unit per input unit.
    covariance : ((float, float), (float, float))
        Covariance of (real part, imaginary part) of ``response``.
    source : str
        Which estimate it is: ``relay`` (fundamental of a limit cycle), ``sweep`` (all rows of a relay sweep together),
        ``harmonic``, ``local polynomial``, ``spectral``, ``closed loop``.
    """

    omega_rad_s: float
    response: complex
    covariance: tuple[tuple[float, float], tuple[float, float]]
    source: str = "relay"

    @property
    def gain(self) -> float:
        """Magnitude of the response."""
        return abs(self.response)

    @property
    def phase_rad(self) -> float:
        """Principal argument of the response, in (-pi, pi]."""
        return math.atan2(self.response.imag, self.response.real)

    def region_radii(self, probability: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Return the semi-axes and their directions of the region that holds G(j omega) with the probability.

        Returns
        -------
        radii : (2,) array
            Semi-axis lengths, output unit per input unit.
        directions : (2, 2) array
            Unit vectors in the (re, im) plane, in columns.

        Notes
        -----
        The quantile is the chi-square one with two degrees of freedom: the covariance is taken as known.
        """
        eigenvalues, directions = np.linalg.eigh(np.array(self.covariance))
        quantile = -2.0 * math.log(1.0 - probability)
        return np.sqrt(np.maximum(eigenvalues, 0.0) * quantile), directions


def as_pairs(covariance: FloatArray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return a (2, 2) covariance of (re, im) as a point keeps it."""
    (a, b), (c, d) = covariance.tolist()
    return (a, b), (c, d)


def points_to_json(points: Sequence[FrequencyPoint]) -> list[dict[str, Any]]:
    """Return the points in the fixed form of ``points.json``: gain, phase in degrees, covariance of (re, im)."""
    return [
        {
            "omega_rad_s": point.omega_rad_s,
            "gain": point.gain,
            "phase_deg": math.degrees(point.phase_rad),
            "cov": [list(row) for row in point.covariance],
            "source": point.source,
        }
        for point in points
    ]


def read_points(path: str | os.PathLike[str]) -> tuple[FrequencyPoint, ...]:
    """Read ``points.json``.

    Raises
    ------
    InputError
        No such file, not JSON, or an entry without frequency, gain, phase or covariance; names the entry.
    """
    where = str(path)
    content = read_json(path)
    entries = content.get("points") if isinstance(content, dict) else None
    if not isinstance(entries, list):
        raise InputError(
            'is not a points file {"points": [...]}',
            where=where,
            remedy="write it with autotune identify frequency",
        )
    if not entries:
        raise InputError("holds no point", where=where, remedy="write it with autotune identify frequency")
    if len(entries) > MOST_POINTS:
        raise InputError(
            f"{len(entries)} points", where=where, remedy=f"give at most {MOST_POINTS}, those around the crossover"
        )
    return points_from_json(entries, where)


def points_from_json(entries: Sequence[Any], where: str) -> tuple[FrequencyPoint, ...]:
    """Return the points of the entries that :func:`points_to_json` wrote.

    Parameters
    ----------
    entries : sequence
        The decoded JSON, one entry a point.
    where : str
        Names them in messages.

    Raises
    ------
    InputError
        An entry without frequency, gain, phase or covariance; names the entry.
    """
    return tuple(_point(entry, f"{where} points[{i}]") for i, entry in enumerate(entries))


def require_regions(points: Sequence[FrequencyPoint], where: str) -> None:
    """Refuse points that no design can rest on: without uncertainty, or at one frequency.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        What a design is asked on.
    where : str
        Their file, for messages.

    Raises
    ------
    InputError
        A covariance that is zero to the precision of its numbers, or fewer than three frequencies.
    """
    for i, point in enumerate(points):
        if point.covariance[0][0] + point.covariance[1][1] <= (_PRECISION * point.gain) ** 2:
            raise InputError(
                f"cov is zero (omega_rad_s = {point.omega_rad_s:g}): margins are kept on a region",
                where=f"{where} points[{i}]",
                remedy="give the covariance of (re, im), or design on a model of the known plant",
            )
    frequencies = np.sort([point.omega_rad_s for point in points])
    different = 1 + int(np.sum(np.diff(frequencies) > _SAME * frequencies[:-1])) if frequencies.size else 0
    if different < 3:
        raise InputError(
            f"{len(points)} points at {different} frequencies"
            if different != 1
            else f"{len(points)} points at 1 frequency",
            where=where,
            remedy="measure at least three frequencies, around the phase of -135 degrees",
        )


def _number(value: Any) -> float:
    """Return a number; a text or a truth value is none."""
    if not is_real(value):
        raise TypeError(value)
    return float(value)


def _point(entry: Any, where: str) -> FrequencyPoint:
    try:
        omega, gain, phase_deg = (_number(entry[key]) for key in ("omega_rad_s", "gain", "phase_deg"))
        covariance = np.array([[_number(one) for one in row] for row in entry["cov"]], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError("needs omega_rad_s, gain, phase_deg, cov [[,],[,]] as numbers", where=where) from None
    for name, value in (("omega_rad_s", omega), ("gain", gain)):
        if not SMALLEST <= value <= LARGEST:
            raise InputError(f"{name} = {value:g}", where=where, remedy=f"it is from {SMALLEST:g} to {LARGEST:g}")
    if not abs(phase_deg) <= LARGEST_PHASE_DEG:
        raise InputError(f"phase_deg = {phase_deg:g}", where=where, remedy="write it in degrees, within +-1e6")
    if covariance.shape != (2, 2) or not np.all(np.abs(covariance) <= LARGEST**2):
        raise InputError("cov must be a 2x2 matrix of finite numbers", where=where)
    eigenvalues = np.linalg.eigvalsh(covariance)
    if eigenvalues.min() < -1e-9 * max(eigenvalues.max(), 1e-300) or not np.allclose(covariance, covariance.T):
        raise InputError("cov must be symmetric and positive semi-definite", where=where)
    return FrequencyPoint(
        omega_rad_s=omega,
        response=complex(gain * np.exp(1j * math.radians(phase_deg))),
        covariance=as_pairs(covariance),
        source=str(entry.get("source", "file"))[:80],
    )
