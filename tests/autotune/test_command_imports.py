"""What the command line leaves out: packages that a command does not need are not imported for it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmarks._front_door_files import DOORS

#: calls the command line and says on its last line which of the packages named first were imported
PROGRAM = """
import contextlib, sys
from autotune.entry import main
packages = sys.argv.pop(1).split(",")
try:
    main()
finally:
    print("imported:", *sorted(set(packages) & set(sys.modules)))
"""
#: of extras, and of rigs
OF_OTHERS = "asammdf,control,distributed,fmpy,h5py,matplotlib,nicegui,pandas,pyarrow,pymodbus,serial,asyncua,snap7"
#: of the method
OF_THE_METHOD = "highspy,llvmlite,numba,numpy,pint,scipy,scipy.signal"


def imported(packages: str, *call: str | Path) -> str:
    given = [sys.executable, "-c", PROGRAM, packages, *map(str, call)]
    ended = subprocess.run(given, capture_output=True, text=True, timeout=250, check=False)
    return ended.stdout.splitlines()[-1]


#: of single commands: doctor's look at what is installed, the start of processes
OF_A_COMMAND = "packaging,importlib.metadata,multiprocessing"


def test_help_imports_no_package_of_the_method_and_none_of_a_single_command() -> None:
    assert imported(f"{OF_OTHERS},{OF_THE_METHOD},{OF_A_COMMAND}", "--help") == "imported:"


def test_tune_imports_no_package_of_a_rig_or_of_an_extra(tmp_path: Path) -> None:
    assert imported(OF_OTHERS, "tune", tmp_path / "missing.csv", "--out", tmp_path / "out") == "imported:"


def test_a_recording_is_tuned_without_what_runs_a_rig_and_without_a_diagnosis(tmp_path: Path) -> None:
    """Nor is what takes longest of scipy to import."""
    door = next(door for door in DOORS if door.name == "tank.csv")
    door.write(tmp_path / door.name)
    others = "autotune.diagnosis,autotune.experiment.run,autotune.pipeline.run,scipy.signal,scipy.stats"
    assert imported(others, "tune", tmp_path / door.name, "--out", tmp_path / "out") == "imported:"
    assert (tmp_path / "out" / "result.json").exists()


@pytest.mark.parametrize(
    "command",
    ["reduce --points", "design --points", "identify frequency", "identify delay", "identify closed-loop"],
)
def test_a_file_that_exists_is_refused_before_the_method_is_imported(command: str, tmp_path: Path) -> None:
    out = tmp_path / "there.json"
    out.touch()
    call = (*command.split(), tmp_path / "missing.csv", "--out", out)
    assert imported("numba,numpy,scipy", *call) == "imported:"
