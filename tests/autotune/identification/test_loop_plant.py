"""A design on a recording of a loop keeps its margins on the whole region of the identified coefficients."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter
from scipy.stats import chi2
from typer.testing import CliRunner

import autotune as at
from autotune.cli import app
from autotune.cli.closed_loop import closed_loop_json
from autotune.errors import InputError
from autotune.identification.closed_loop.identify import ClosedLoopIdentification
from autotune.identification.closed_loop.loop_plant import loop_plant, read_loop_region

TS = 0.2
PLANTS = {
    "integrating": (at.TransferFunction(num=(1.0,), den=(1.0, 1.0, 0.0)), 0.3, 10.0),
    "resonant": (at.TransferFunction(num=(1.0,), den=(1.0, 0.3, 1.0)), 0.1, 1.0),
}


def identified(name: str, seed: int, noise: float = 0.05) -> ClosedLoopIdentification:
    """A PI loop under a random binary set-point, of order 2, noise inside the loop."""
    plant, K, Ti_s = PLANTS[name]
    num, a, _ = cont2discrete((plant.num, plant.den), TS)
    b, d, c = np.ravel(num), np.array([K * (1.0 + TS / Ti_s), -K]), np.array([1.0, -1.0])
    whole = np.convolve(a, c) + np.convolve(b, d)
    rng = np.random.default_rng(seed)
    r, e = np.repeat(rng.choice([-1.0, 1.0], 150), 10), noise * rng.standard_normal(1500)
    y = lfilter(np.convolve(b, d), whole, r) + lfilter(np.convolve(a, c), whole, e)
    u = lfilter(np.convolve(a, d), whole, r) - lfilter(np.convolve(a, d), whole, e)
    record = at.Recording(t=np.arange(1500) * TS, u=u, y=y, extra={"r": r}, name=name)
    found: ClosedLoopIdentification = at.closed_loop(record, order=2)
    return found


@pytest.mark.parametrize("name", PLANTS)
def test_without_noise_it_is_the_plant(name: str) -> None:
    fit = loop_plant(identified(name, 0, noise=0.0).structures)
    omega = np.geomspace(0.05, 5.0, 20)
    assert fit is not None
    np.testing.assert_allclose(fit.plant.response(omega), PLANTS[name][0].response(omega), rtol=1e-6)


def test_the_region_holds_the_true_coefficients() -> None:
    """A 95 % region misses them in two of forty loops on average, in seven of forty once in two hundred times."""
    num, den, _ = cont2discrete((PLANTS["resonant"][0].num, PLANTS["resonant"][0].den), TS)
    true, inside = np.array([*np.ravel(num)[1:], *den[1:]]), 0
    for seed in range(40):
        fit = loop_plant(identified("resonant", seed).structures)
        assert fit is not None
        off = fit.parameters - true
        inside += bool(off @ np.linalg.solve(fit.covariance, off) < chi2.ppf(0.95, true.size))
    assert inside >= 34


def test_the_file_of_a_loop_keeps_the_region_and_a_design_uses_it(tmp_path: Path) -> None:
    found = identified("resonant", 1)
    path = tmp_path / "closed_loop.json"
    path.write_text(json.dumps(closed_loop_json(found)), encoding="utf-8")
    fit, read = loop_plant(found.structures), read_loop_region(path)
    assert fit is not None
    assert read is not None
    again = read.plant_fit()
    assert again is not None
    np.testing.assert_allclose(again.covariance, fit.covariance)
    omega = np.geomspace(0.05, 5.0, 20)
    np.testing.assert_allclose(again.plant.response(omega), fit.plant.response(omega), rtol=1e-9)
    from_file, direct = at.tune(str(path), noise_gain=5.0), at.tune(found, noise_gain=5.0)
    assert abs(from_file.controller.K / direct.controller.K - 1.0) < 1e-3
    ran = CliRunner().invoke(
        app, ["design", "--points", str(path), "--noise-gain", "5", "--out", str(tmp_path / "design.json")]
    )
    assert ran.exit_code == 0, ran.output
    assert "joint region" in ran.output
    assert json.loads((tmp_path / "design.json").read_text())["K"] == pytest.approx(direct.controller.K, rel=1e-3)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"covariance": [[1.0]]}, "covariance must be a"),
        ({"free": [4, 1, 2, 3]}, "free must be ascending"),
        ({"den": [2.0, 0.0, 0.0]}, "den begin with 1"),
        ({"covariance": (-np.eye(4)).tolist()}, "diagonal of covariance must be positive"),
        ({"covariance": (np.eye(4) + 3.0 * np.eye(4)[::-1]).tolist()}, "positive semi-definite"),
        ({"nonsense": 1.0}, "nonsense"),
    ],
)
def test_a_region_that_is_none_is_refused_by_its_key(tmp_path: Path, wrong: dict[str, Any], said: str) -> None:
    region = {
        "num": [0.0, 0.1, 0.1],
        "den": [1.0, -1.5, 0.7],
        "input_delay": 0,
        "sample_time_s": 0.1,
        "free": [1, 2, 3, 4],
        "covariance": (1e-4 * np.eye(4)).tolist(),
        "degrees_of_freedom": 100,
    }
    path = tmp_path / "closed_loop.json"
    path.write_text(json.dumps({"plant_region": region}), encoding="utf-8")
    assert read_loop_region(path) is not None
    path.write_text(json.dumps({"plant_region": region | wrong}), encoding="utf-8")
    with pytest.raises(InputError, match=said):
        read_loop_region(path)


@pytest.mark.parametrize("name", PLANTS)
def test_a_design_keeps_what_it_prints_on_the_true_plant(name: str) -> None:
    for seed in range(3):
        found = at.tune(identified(name, seed), noise_gain=5.0)
        true = at.margins(PLANTS[name][0], found)
        assert true.stable
        assert true.modulus >= found.margins.modulus - 0.005
        assert true.phase_rad >= found.margins.phase_rad - 0.005
