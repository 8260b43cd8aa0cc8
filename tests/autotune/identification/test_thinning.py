from __future__ import annotations

import numpy as np
import pytest

from autotune.identification.frequency.thinning import MOST, thin_points
from autotune.points import FrequencyPoint


def spectrum(count: int, sd: float, seed: int = 0) -> list[FrequencyPoint]:
    """Return noisy points of 2 exp(-0.3 s)/(s + 1)^2."""
    rng = np.random.default_rng(seed)
    omega = np.geomspace(0.02, 12.0, count)
    g = 2.0 * np.exp(-0.3j * omega) / (1j * omega + 1.0) ** 2
    noisy = g + sd * (rng.standard_normal(count) + 1j * rng.standard_normal(count))
    covariance = ((sd**2, 0.0), (0.0, sd**2))
    return [
        FrequencyPoint(omega_rad_s=float(w), response=complex(v), covariance=covariance)
        for w, v in zip(omega, noisy, strict=True)
    ]


def test_few_points_stay_as_they_are() -> None:
    points = spectrum(MOST, 0.01)
    assert thin_points(points) == tuple(points)


@pytest.mark.parametrize("count", [1_000, 30_000])
def test_the_information_is_kept_and_the_mean_is_where_the_plant_is(count: int) -> None:
    points = spectrum(count, 0.05)
    few = thin_points(points)
    assert len(few) <= MOST
    information = sum(np.linalg.inv(np.array(point.covariance)).trace() for point in points)
    kept = sum(np.linalg.inv(np.array(point.covariance)).trace() for point in few)
    assert kept == pytest.approx(information, rel=0.15)
    omega = np.array([point.omega_rad_s for point in few])
    truth = 2.0 * np.exp(-0.3j * omega) / (1j * omega + 1.0) ** 2
    errors = np.array([point.response for point in few]) - truth
    scaled = np.concatenate([errors.real, errors.imag]) / np.tile([point.covariance[0][0] ** 0.5 for point in few], 2)
    assert 0.85 < float(np.sqrt(np.mean(scaled**2))) < 1.15


def test_a_resonance_narrower_than_a_band_widens_its_region() -> None:
    omega = np.linspace(0.9, 1.1, 4000)
    g = 1.0 / (1.0 - omega**2 + 2e-4j * omega)
    sharp = [
        FrequencyPoint(omega_rad_s=float(w), response=complex(v), covariance=((1e-4, 0.0), (0.0, 1e-4)))
        for w, v in zip(omega, g, strict=True)
    ]
    few = thin_points(sharp, 10)
    nearest = min(few, key=lambda point: abs(point.omega_rad_s - 1.0))
    assert nearest.covariance[0][0] > 1e3 * 1e-4 / 400
