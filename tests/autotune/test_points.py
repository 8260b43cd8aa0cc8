from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import InputError
from autotune.points import FrequencyPoint, points_to_json, read_points, require_regions


def test_points_read_back_in_their_fixed_form(tmp_path: Path) -> None:
    point = FrequencyPoint(omega_rad_s=2.5, response=-3 + 4j, covariance=((0.04, 0.01), (0.01, 0.09)), source="relay")
    entry = points_to_json([point])[0]
    assert entry["gain"] == pytest.approx(5.0)
    assert entry["phase_deg"] == pytest.approx(np.degrees(np.arctan2(4, -3)))
    path = tmp_path / "points.json"
    path.write_text(json.dumps({"points": [entry]}))
    (back,) = read_points(path)
    assert back.response == pytest.approx(point.response, rel=1e-12)
    assert back.covariance == point.covariance


def test_the_region_of_95_per_cent_holds_95_per_cent() -> None:
    rng = np.random.default_rng(7)
    covariance = np.array([[0.04, 0.03], [0.03, 0.09]])
    point = FrequencyPoint(omega_rad_s=1.0, response=0j, covariance=((0.04, 0.03), (0.03, 0.09)))
    radii, directions = point.region_radii(0.95)
    draws = rng.multivariate_normal([0, 0], covariance, 100_000) @ directions / radii
    assert np.mean(np.sum(draws**2, axis=1) < 1) == pytest.approx(0.95, abs=0.003)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('{"points": [{"omega_rad_s": 1}]}', r"points\[0\]: needs"),
        ('{"points": [{"omega_rad_s": -1, "gain": 1, "phase_deg": 0, "cov": [[1,0],[0,1]]}]}', "omega_rad_s = -1"),
        ('{"points": [{"omega_rad_s": 1, "gain": 1, "phase_deg": 0, "cov": [[1,2],[2,1]]}]}', "semi-definite"),
        ("[]", "is not a points file"),
    ],
)
def test_a_wrong_points_file_is_refused(tmp_path: Path, content: str, says: str) -> None:
    path = tmp_path / "points.json"
    path.write_text(content)
    with pytest.raises(InputError, match=says):
        read_points(path)


def at_frequencies(*omega: float, variance: float = 1e-4) -> list[FrequencyPoint]:
    return [
        FrequencyPoint(omega_rad_s=w, response=2.0 / (1.0 + 1j * w), covariance=((variance, 0.0), (0.0, variance)))
        for w in omega
    ]


@pytest.mark.parametrize(
    ("points", "says"),
    [
        (at_frequencies(1.0, 2.0, 4.0, variance=0.0), r"p\.json points\[0\]: cov is zero .* margins are kept"),
        (at_frequencies(1.0, 2.0, 4.0, variance=1e-40), "cov is zero"),
        ([*at_frequencies(1.0, 2.0, 4.0), *at_frequencies(8.0, variance=0.0)], r"points\[3\]: cov is zero"),
        (at_frequencies(2.0, 2.0, 2.0, 2.0), r"p\.json: 4 points at 1 frequency"),
        (at_frequencies(2.0, 2.0000001, 4.0), "3 points at 2 frequencies"),
    ],
)
def test_no_design_rests_on_points_without_uncertainty_or_at_one_frequency(
    points: list[FrequencyPoint], says: str
) -> None:
    with pytest.raises(InputError, match=says):
        require_regions(points, "p.json")


def test_points_at_three_frequencies_with_regions_are_designed_on() -> None:
    require_regions(at_frequencies(1.0, 2.0, 2.0, 4.0), "p.json")
