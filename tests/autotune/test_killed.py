"""A kill at any write of a command leaves the old file or the new one, whole."""

from __future__ import annotations

import json
import shutil
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pyarrow.parquet
import pytest
import typer

from autotune import cli
from autotune.api.examples import BALL
from autotune.model_tables import write_model
from autotune.points import points_to_json
from tests.autotune import moments_of_writing
from tests.autotune.equations.fmu_build import description
from tests.autotune.test_cli_prove import CLEAN
from tests.autotune.test_pipeline import points_of
from tests.autotune.test_pipeline_investigation import WITHOUT, tanks_model
from tests.forked import call
from tests.fuzz.moments import CONFIG, inputs
from tests.sim.recorded_rig import write_rig

CONTROLLER = 'kind = "pi"\nK = 0.5\nTi_s = 1.0\n'
LAG = 'name = "lag"\n\n[[block]]\nname = "plant"\nplace = "plant"\nnum = [2.0]\nden = [1.0, 1.0]\n'
EXPORT = """name = "plant"
task = "identify"
[export]
time = "time"
[[loop]]
name = "A"
file = "export.csv"
u = "A.OP"
y = "A.PV"
[[loop]]
name = "B"
file = "export.csv"
u = "A.OP"
y = "B.PV"
"""
#: Journals: they grow by whole lines, at their own place.
GROWING = {
    "run": ("progress.jsonl", "recording.csv", "verification.csv", "journal.jsonl", "audit.jsonl"),
    "deploy": ("journal.jsonl", "audit.jsonl"), "verify": ("verification.csv",), "dither": ("d.csv",),
    "investigate": ("rig_1.csv",),
}  # fmt: skip
#: What a command is given and the results that it writes.
COMMANDS: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "schema": (["schema", "--out", "o/s.json"], ("o/s.json",)),
    "margins": (["margins", "--model", "model.toml", "--controller", "c.toml", "--out", "o/m.json"], ("o/m.json",)),
    "controller": (["controller", "--controller", "c.toml", "--out", "o/pi.c"], ("o/pi.c",)),
    "design": (
        ["design", "--model", "model.toml", "--out", "o/d.json", "--controller", "o/c.toml"], ("o/d.json", "o/c.toml"),
    ),
    "reduce": (["reduce", "--points", "points.json", "--out", "o/model.toml"], ("o/model.toml",)),
    "simulate": (["simulate", "--model", "model.toml", "r.csv", "--out", "o/y.csv"], ("o/y.csv",)),
    "identify frequency": (["identify", "frequency", "r.csv", "--out", "o/f.json"], ("o/f.json",)),
    "identify delay": (["identify", "delay", "r.csv", "--order", "1", "--out", "o/d.json"], ("o/d.json",)),
    "identify closed-loop": (["identify", "closed-loop", "r.csv", "--out", "o/l.json"], ("o/l.json",)),
    "watch": (["watch", "r.csv", "--order", "1", "--out", "o/w.csv"], ("o/w.csv",)),
    "tune": (["tune", "r.csv", "--out", "o"], ("o/result.json", "o/controller.toml", "o/report.html")),
    "diagnose": (
        ["diagnose", "--model", "lag.toml", "short.csv", "--out", "o"],
        ("o/diagnosis.json", "o/extended_model.toml", "o/report.html"),
    ),
    "diagnose --routine": (["diagnose", "--routine", "swing.csv", "--out", "o"], ("o/routine.json", "o/report.html")),
    "model from-text": (["model", "from-text", "2/(s+1)", "--out", "o/m.toml"], ("o/m.toml",)),
    "model from-matlab": (["model", "from-matlab", "[2]", "[1 1]", "--out", "o/m.toml"], ("o/m.toml",)),
    "model from-control": (["model", "from-control", "system.py:lag", "--out", "o/m.toml"], ("o/m.toml",)),
    "model from-fmu": (["model", "from-fmu", "rig.fmu", "--out", "o/m.toml"], ("o/m.toml",)),
    "model linearise": (["model", "linearise", "lag.toml", "--at", "u=1", "--out", "o/m.toml"], ("o/m.toml",)),
    "model export": (["model", "export", "lag.toml", "--form", "text", "--out", "o/m.txt"], ("o/m.txt",)),
    "reference": (
        ["reference", "--model", "model.toml", "--u-min", "-3", "--u-max", "3", "--out", "o/r.csv"], ("o/r.csv",),
    ),
    "rst": (
        ["rst", "--model", "lag.toml", "--dominant", "1", "--rest", "5", "--out", "o/r.json",
         "--controller", "o/c.toml"],
        ("o/r.json", "o/c.toml"),
    ),
    "validate": (
        ["validate", "--model", "lag.toml", "--against", "lag.toml", "--controller", "c.toml", "--out", "o/v.json"],
        ("o/v.json",),
    ),
    "import": (["import", "r.csv", "--out", "o/r.csv"], ()),
    "init": (["init", "rig.toml", "--kind", "simulated", "--plant", "ball"], ()),
    "paper relay": (["paper", "relay", "--out", "o/p.html"], ("o/p.html",)),
    "paper delay": (["paper", "delay", "--sets", "2", "--out", "o/p.html"], ("o/p.html",)),
    "paper closed-loop": (["paper", "closed-loop", "--sets", "1", "--out", "o/p.html"], ("o/p.html",)),
    "dither": (["dither", str(CONFIG), "--duration", "3", "--amplitude", "0.1", "--out", "o/d.csv"], ()),
    "deploy": (["deploy", str(CONFIG), "--controller", "ball_pi.toml", "--no-verify", "--yes", "--out", "o"], ()),
    "verify": (
        ["verify", str(CONFIG), "--points", "ball.json", "--controller", "ball_pi.toml", "--out", "o"], (),
    ),
    "investigate": (
        ["investigate", str(CONFIG.with_name("two_tank_sim.toml")), "--model", "tanks.toml", "--rounds", "1",
         "--duration", "200", *(word for name in WITHOUT for word in ("--without", name)), "--out", "o"],
        (),
    ),
    "prove": (["prove", "--cases", "1", "--seed", str(CLEAN), "--ties", "0", "--workers", "1", "--out", "o"], ()),
    "prove --recordings": (
        ["prove", "--recordings", "rigs", "--cases", "1", "--workers", "1", "--out", "o"], (),
    ),
    "batch": (["batch", "campaign.toml", "--out", "o", "--workers", "1"], ()),
    "batch of an export": (["batch", "export.toml", "--out", "o", "--workers", "1"], ()),
    "run": (["run", str(CONFIG), "--diagnose", "--out", "o"], ()),
}  # fmt: skip

OLD = b"# another result\n"


def kept(tmp_path: Path, command: list[str], results: tuple[str, ...]) -> list[Path]:
    """Run a command in a new folder beside old results, if any; return what is on the disk before every change."""
    work, snapshots = tmp_path / "work", tmp_path / "moments"
    work.mkdir()
    snapshots.mkdir()
    inputs(work)
    (work / "c.toml").write_text(CONTROLLER)
    (work / "lag.toml").write_text(LAG)
    (work / "system.py").write_text("import control\nlag = control.tf([2.0], [1.0, 1.0])\n")
    with zipfile.ZipFile(work / "rig.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", description(("CoSimulation",)))
        archive.writestr(f"binaries/{fmpy.platform}/rig{fmpy.sharedLibraryExtension}", b"")
    write_model(tanks_model(), work / "tanks.toml", {})
    (work / "ball_pi.toml").write_text('kind = "pi"\nK = -0.02\nTi_s = 3.6\n')
    ball = points_of(BALL, np.array([0.9, 1.5, 2.4, 3.5, 5.0]), 0.004)
    (work / "ball.json").write_text(json.dumps({"points": points_to_json(ball)}))
    (work / "short.csv").write_text("".join((work / "r.csv").read_text().splitlines(keepends=True)[:400]))
    swing = np.sin(np.arange(400) / 4.0)
    np.savetxt(work / "swing.csv", np.column_stack([np.arange(400), swing, np.roll(swing, 3)]), header="t,u,y",
               delimiter=",", comments="")  # fmt: skip
    write_rig(work / "rigs" / "servo", rows=600)
    (work / "export.toml").write_text(EXPORT)
    lines = (work / "r.csv").read_text().splitlines()[1:]
    rows = [f"{1.7e9 + float(t):.1f},{u},{y},{y}" for t, u, y in (line.split(",") for line in lines)]
    (work / "export.csv").write_text("\n".join(["time,A.OP,A.PV,B.PV", *rows]) + "\n")
    for result in results:
        (work / result).parent.mkdir(exist_ok=True)
        (work / result).write_bytes(OLD)
    replacing = ["--overwrite"] if results else []
    given = [moments_of_writing.__file__, str(work), str(snapshots), *command, *replacing]
    status, printed = call(moments_of_writing.main, given, work)
    assert status == 0, printed[-2000:]
    count = len([place for place in snapshots.iterdir() if place.is_dir()])
    return [snapshots / str(number) for number in range(count)]


def assert_whole(file: Path) -> None:
    """Assert that a file is one that its readers read."""
    content = file.read_bytes()
    match file.suffix:
        case ".json":
            json.loads(content)
        case ".jsonl":
            assert content == b"" or content.endswith(b"\n")
            for line in content.splitlines():
                json.loads(line)
        case ".toml":
            tomllib.loads(content.decode())
        case ".csv":
            assert content.endswith(b"\n")
        case ".parquet":
            pyarrow.parquet.read_table(file)
        case ".html":
            assert content.rstrip().endswith(b"</html>")


def writing(command: Any, *words: str) -> Iterator[str]:
    """Yield the commands, below this one, that have a place to write to."""
    for name, below in getattr(command, "commands", {}).items():
        yield from writing(below, *words, name)
    if any("--out" in option.opts for option in command.params):
        yield " ".join(words)


def test_every_command_that_writes_is_killed_here() -> None:
    assert set(writing(typer.main.get_command(cli.app))) <= set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_kill_at_any_write_leaves_the_old_files_or_the_new_ones_whole(tmp_path: Path, name: str) -> None:
    command, results = COMMANDS[name]
    moments = kept(tmp_path, command, results)
    opened = tmp_path / "moments" / "opened.txt"
    if opened.exists():
        assert {Path(file).name for file in opened.read_text().split()} <= set(GROWING.get(name, ()))
    assert len(moments) > 3
    new = {result: (moments[-1] / result).read_bytes() for result in results}
    assert OLD not in new.values()
    for moment in moments:
        for result in results:
            assert (moment / result).read_bytes() in (OLD, new[result]), f"{result} in {moment.name}"
        for file in moment.rglob("*"):
            if file.is_file() and ".part-" not in str(file) and file.read_bytes() != OLD:
                assert_whole(file)
    assert not list(moments[-1].rglob(".part-*"))
    shutil.rmtree(tmp_path / "moments")
