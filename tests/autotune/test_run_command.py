from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.errors import InputError
from autotune.recording import read_recording

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def autotune(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "autotune.cli", *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "out"
    done = autotune("run", CONFIGS / "ball_sim.toml", "--out", out)
    assert done.returncode == 0, done.stderr
    assert "Accepted" in done.stdout
    return out


def test_one_command_ends_with_a_verified_controller_and_every_file(finished: Path) -> None:
    result = json.loads((finished / "result.json").read_text())
    assert set(result) == {
        "points", "designed_on", "fitted_plant", "reduced_model", "noise_gain", "checks", "controller", "margins",
        "validation", "verification", "experiment",
    }  # fmt: skip
    assert len(result["points"]) == 5
    assert result["verification"]["accepted"]
    assert result["experiment"]["reason"] == "completed"
    assert {"nu_gap", "b_reduced", "b_rig", "scaling"} <= set(result["validation"])
    # (-66, 5.15) instead of the paper's (-65, 5.17): the conditions (5) are held on the regions of the points
    assert result["reduced_model"]["G_r"] == pytest.approx(-66.0, rel=0.02)
    assert result["reduced_model"]["omega_d_rad_s"] == pytest.approx(5.15, rel=0.03)
    # straight on the points: between the -0.025 of the reduced model and the -0.0368 of the plant known exactly
    assert result["designed_on"] == "points"
    assert -0.0368 < result["controller"]["K"] < -0.028
    assert all(check["kept"] for check in result["checks"])
    for name in ("recording.csv", "recording.toml", "verification.csv", "journal.jsonl", "report.html"):
        assert (finished / name).stat().st_size > 0


def test_the_new_gains_are_in_the_journal_before_and_after_they_are_written(finished: Path) -> None:
    notes = [json.loads(line) for line in (finished / "journal.jsonl").read_text().splitlines()]
    assert [note["gains"] for note in notes][:3] == ["read", "writing", "written and read back"]
    assert notes[0]["K"] == -0.01
    times = [datetime.fromisoformat(note["at"]) for note in notes]
    assert times == sorted(times)
    assert all(time.tzinfo is not None for time in times)


def test_every_verification_keeps_its_files(finished: Path) -> None:
    for _ in range(2):
        before = {file.name: file.read_bytes() for file in finished.glob("veri*")}
        done = autotune("verify", CONFIGS / "ball_sim.toml", "--run", finished)
        assert done.returncode == 0, done.stderr
        new = {file.name for file in finished.glob("veri*")} - set(before)
        assert sorted({Path(name).suffix for name in new}) == [".csv", ".html", ".json", ".toml"]
        (page,) = (name for name in new if name.endswith(".html"))
        assert page in done.stdout
        assert json.loads((finished / page).with_suffix(".json").read_text())["verification"]["accepted"]
        assert {name: (finished / name).read_bytes() for name in before} == before


def test_a_run_that_is_stopped_leaves_a_page_that_says_why_and_how_the_rig_was_left(tmp_path: Path) -> None:
    hurried = (CONFIGS / "ball_sim.toml").read_text().replace("time_s = 180.0", "time_s = 30.0")
    (tmp_path / "hurried.toml").write_text(hurried)
    done = autotune("run", tmp_path / "hurried.toml", "--out", tmp_path / "out")
    assert done.returncode == 3
    page = (tmp_path / "out" / "report.html").read_text()
    assert "time over" in page
    assert "the rig has its safe output" in page
    assert "the rig has its safe output" not in done.stderr  # the one line speaks of it where it is not so


def test_the_report_asks_nothing_of_the_network(finished: Path) -> None:
    page = (finished / "report.html").read_text()
    outside = re.findall(r"<(?:script|link|img|iframe)[^>]*(?:src|href)\s*=", page.split("</style>")[0])
    assert outside == []
    assert page.count('class="chart"') >= 6


def test_a_second_run_does_not_overwrite_the_first(finished: Path) -> None:
    before = (finished / "recording.csv").read_bytes()
    done = autotune("run", CONFIGS / "ball_sim.toml", "--out", finished)
    assert done.returncode == 2
    assert "nothing is overwritten" in done.stderr
    assert (finished / "recording.csv").read_bytes() == before


def test_a_dry_run_of_a_modbus_config_runs_its_twin(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = autotune("run", CONFIGS / "ball_modbus_tcp.toml", "--out", out, "--dry-run", "--no-verify")
    assert done.returncode == 0, done.stderr
    assert json.loads((out / "result.json").read_text())["verification"] is None
    assert "not verified" in done.stdout


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -9)])
def test_every_signal_leaves_a_readable_recording_and_says_why(
    tmp_path: Path, number: signal.Signals, status: int
) -> None:
    out = tmp_path / "out"
    recording = out / "recording.csv"
    process = subprocess.Popen(
        [sys.executable, "-m", "autotune.cli", "run", str(CONFIGS / "ball_sim.toml"), "--out", str(out)],
        stderr=subprocess.PIPE,
        text=True,
    )
    while process.poll() is None and not (recording.exists() and recording.stat().st_size > 20_000):
        pass
    process.send_signal(number)
    _, errors = process.communicate()
    assert process.returncode == status
    rows = read_recording(recording)
    assert len(rows) > 100
    assert np.all(np.isfinite(rows.u))
    ended = rows.metadata["ended"]["reason"]
    if number == signal.SIGKILL:
        assert "killed" in ended
    else:
        assert errors.strip().count("\n") == 0
        assert "stopped by" in errors
        assert f"autotune run --resume {out}" in errors
        assert "stopped by" in ended
        assert rows.metadata["ended"]["output"] == "safe output"


KILLED_IN_THE_THIRD_SETTING = """
import os, signal, sys
from pathlib import Path
from autotune.cli.common import rig_of
from autotune.config import load_config
from autotune.pipeline import tune

def kill(progress):
    if len(progress.points) == 2:
        os.kill(os.getpid(), signal.SIGKILL)

config = load_config(sys.argv[1])
tune(rig_of(config), config, Path(sys.argv[2]), on_status=kill)
"""


@pytest.fixture(scope="module")
def resumed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """Return the folder of a run that was killed and gone on with, and its first recording as it was left."""
    out = tmp_path_factory.mktemp("resumed")
    command = [sys.executable, "-c", KILLED_IN_THE_THIRD_SETTING, str(CONFIGS / "ball_sim.toml"), str(out)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    before = (out / "recording.csv").read_bytes()
    done = autotune("run", "--resume", out)
    assert done.returncode == 0, done.stderr
    assert "Accepted" in done.stdout
    return out, before


def test_a_killed_run_is_gone_on_with_from_its_folder_alone(resumed: tuple[Path, bytes], finished: Path) -> None:
    out, before = resumed
    result, whole = (json.loads((folder / "result.json").read_text()) for folder in (out, finished))
    first, second = result["experiment"]["parts"]
    assert len(result["points"]) == len(whole["points"]) == 5
    assert first["points"] == 2
    assert second["points"] >= 3  # the cycles that all points are estimated from together, begun anew
    assert "killed" in first["ended"]
    assert second["rig_time_s"] < 1.3 * whole["experiment"]["rig_time_s"]
    assert (out / "recording.csv").read_bytes() == before
    # The second sitting has noise of its own, so that the two are as far apart as runs of two seeds. Of fourteen whole
    # runs the logarithms have standard deviations of .053 (K: the norm is flat along gain and integral time), .019
    # (norm) and .006 (modulus margin), of eight that were gone on with .045, .017 and .005, the means being the same.
    # The difference of two runs is within 3.5 sqrt(2) times these but once in 2,000. Rounding makes other runs of the
    # same seeds where a computer adds up in another order: an interval of 95 % was left on one of them.
    for of, name, sd in (("controller", "K", 0.053), ("controller", "h2", 0.019), ("margins", "modulus", 0.006)):
        assert abs(math.log(result[of][name] / whole[of][name])) < 3.5 * math.sqrt(2.0) * sd, name
    assert "recording-2.csv" in (out / "report.html").read_text()


@pytest.mark.parametrize("sittings", [1, 2])
def test_a_runs_recordings_give_its_own_points_and_gains_to_the_last_digit(
    request: pytest.FixtureRequest, sittings: int, tmp_path: Path
) -> None:
    out = request.getfixturevalue("finished") if sittings == 1 else request.getfixturevalue("resumed")[0]
    recordings = [out / "recording.csv", *([out / "recording-2.csv"] if sittings == 2 else [])]
    done = autotune("tune", *recordings, "--out", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    run, again = (json.loads((folder / "result.json").read_text()) for folder in (out, tmp_path / "again"))
    for part in ("points", "reduced_model", "controller", "margins", "validation"):
        assert again[part] == run[part], part
    assert autotune("identify", "frequency", *recordings, "--out", tmp_path / "p.json").returncode == 0
    assert json.loads((tmp_path / "p.json").read_text())["points"] == run["points"]


def test_what_cannot_be_gone_on_with_is_refused_with_the_remedy(resumed: tuple[Path, bytes], tmp_path: Path) -> None:
    out, _ = resumed
    calls = {
        ("--resume", out): "autotune verify",
        ("--resume", tmp_path): "no config.toml",
        ("--resume", out, "--out", tmp_path): "--out for a new run, or --resume",
        (CONFIGS / "servo_sim.toml", "--resume", out): "rig.plant = 'servo', was 'ball'",
    }
    for arguments, said in calls.items():
        error = CliRunner().invoke(app, ["run", *map(str, arguments)]).exception
        assert isinstance(error, InputError)
        assert said in str(error)


def test_verified_gains_are_deployed_and_present_ones_verified_with_the_points_of_a_run(finished: Path) -> None:
    config, run = str(CONFIGS / "ball_sim.toml"), str(finished)
    for command, name, said in (
        ("deploy", "deploy", "host's law verified on a simulated rig."),
        ("verify", "verify", "Accepted"),
    ):
        done = CliRunner().invoke(app, [command, config, "--run", run, *(["--yes"] if command == "deploy" else [])])
        assert done.exit_code == 0, done.output
        assert said in done.stdout
        told = json.loads((finished / f"{name}.json").read_text())
        assert told["verification"]["accepted"]
        assert (finished / f"{name}.html").stat().st_size > 0
    assert told["controller"]["K"] == -0.01  # what the rig holds when it is delivered
    steps = [json.loads(line)["gains"] for line in (finished / "journal.jsonl").read_text().splitlines()]
    assert steps[-2:] == ["writing", "verified, kept"]  # no law but the host's would run there
    assert read_recording(finished / "verification-2.csv").metadata["ended"]["output"] == "safe output"
