"""Frequency points: the complex gain of the plant at one frequency, with its covariance."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import InputError


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
        Which estimate it is: ``relay`` (fundamental of a limit cycle), ``harmonic``, ``local polynomial``,
        ``spectral``, ``closed loop``.
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


def responses(points: Sequence[FrequencyPoint]) -> tuple[FloatArray, ComplexArray]:
    """Return the frequencies [rad/s] and the complex gains of the points, in ascending frequency."""
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    return (
        np.array([point.omega_rad_s for point in ordered], dtype=np.float64),
        np.array([point.response for point in ordered], dtype=np.complex128),
    )


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
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        entries = content["points"]
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=where, remedy="check the path") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(
            'is not a points file {"points": [...]}',
            where=where,
            remedy="write it with autotune identify frequency",
        ) from None
    return points_from_json(entries, where)


def points_from_json(entries: Sequence[Any], where: str) -> tuple[FrequencyPoint, ...]:
    """Return the points of the entries that :func:`points_to_json` wrote; ``where`` is for messages.

    Raises
    ------
    InputError
        An entry without frequency, gain, phase or covariance; names the entry.
    """
    return tuple(_point(entry, f"{where} points[{i}]") for i, entry in enumerate(entries))


def _point(entry: Any, where: str) -> FrequencyPoint:
    try:
        omega, gain, phase_deg = (float(entry[key]) for key in ("omega_rad_s", "gain", "phase_deg"))
        covariance = np.array(entry["cov"], dtype=np.float64)
    except (KeyError, TypeError, ValueError):
        raise InputError("needs omega_rad_s, gain, phase_deg, cov [[,],[,]]", where=where) from None
    eigenvalues = np.linalg.eigvalsh(covariance) if covariance.shape == (2, 2) else np.array([-1.0])
    if not (math.isfinite(gain) and math.isfinite(phase_deg) and omega > 0 and gain > 0):
        raise InputError("omega_rad_s and gain must be positive numbers", where=where)
    if not np.all(np.isfinite(covariance)) or eigenvalues.min() < -1e-9 * max(eigenvalues.max(), 1e-300):
        raise InputError("cov must be a 2x2 positive semi-definite matrix", where=where)
    return FrequencyPoint(
        omega_rad_s=omega,
        response=complex(gain * np.exp(1j * math.radians(phase_deg))),
        covariance=(
            (float(covariance[0, 0]), float(covariance[0, 1])),
            (float(covariance[1, 0]), float(covariance[1, 1])),
        ),
        source=str(entry.get("source", "file")),
    )
