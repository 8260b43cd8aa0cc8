"""``autotune tune`` on points of more than one kind."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.cli.closed_loop import closed_loop_json
from autotune.identification.closed_loop.identify import identify_closed_loop
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint, points_to_json
from tests.autotune.identification.test_closed_loop import ball_loop

BALL = TransferFunction(num=(-65.5,), den=(0.3836, 1.0, 0.0))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Relay points of the ball known to 0.5 %, and the file of a closed-loop identification of the same ball."""
    folder = tmp_path_factory.mktemp("points")
    omega = np.array([1.1, 1.6, 2.3, 3.2, 4.4])
    relay = [
        FrequencyPoint(
            omega_rad_s=float(w),
            response=complex(value),
            covariance=((float(abs(0.005 * value) ** 2), 0.0), (0.0, float(abs(0.005 * value) ** 2))),
        )
        for w, value in zip(omega, BALL.response(omega), strict=True)
    ]
    (folder / "points.json").write_text(json.dumps({"points": points_to_json(relay)}))
    found = identify_closed_loop(ball_loop(), order=2)
    (folder / "closed_loop.json").write_text(json.dumps(closed_loop_json(found)))
    return folder / "points.json", folder / "closed_loop.json"


def tuned(out: Path, *files: Path) -> dict[str, dict[str, float]]:
    options = [part for file in files for part in ("--points", str(file))]
    done = CliRunner().invoke(app, ["tune", *options, "--out", str(out)])
    assert done.exit_code == 0, done.output
    content: dict[str, dict[str, float]] = json.loads((out / "result.json").read_text())
    return content


def test_relay_and_closed_loop_points_go_through_one_reduction_and_one_page(
    tmp_path: Path, files: tuple[Path, Path]
) -> None:
    relay, loop = files
    alone = tuned(tmp_path / "loop", loop)
    both = tuned(tmp_path / "both", relay, loop)
    # the smallest |G_r| that (5) allows is the plant's own gain, and the points' regions add little to it
    assert alone["reduced_model"]["G_r"] == pytest.approx(-65.5, rel=0.03)
    assert both["reduced_model"]["G_r"] == pytest.approx(-65.5, rel=0.02)
    assert alone["controller"]["K"] == pytest.approx(both["controller"]["K"], rel=0.1)
    assert len(both["points"]) == 8  # five of the relay, three that an order of two determines
    page = (tmp_path / "both" / "report.html").read_text()
    for name in ("relay, 95 %", "closed loop, 95 %"):
        assert name in page
    assert "closed loop, 95 %" not in (tmp_path / "loop" / "report.html").read_text()  # one kind needs no legend


def test_nothing_to_tune_on_is_said(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["tune", "--out", str(tmp_path / "out")])
    assert done.exit_code != 0
    assert "give recordings or --points" in str(done.exception)
