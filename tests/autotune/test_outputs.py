from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import pytest

from autotune import outputs, whole_files
from autotune.errors import InputError
from autotune.outputs import Output, OutputFolder, claim
from autotune.recording import RecordingWriter, read_recording
from autotune.whole_files import append_whole, write_json, write_whole
from tests.autotune.command import autotune

WRITING = (outputs.__file__, whole_files.__file__)


def test_nothing_that_exists_is_overwritten_unless_it_is_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "a.json"
    Output(out).json({"a": 1})
    with pytest.raises(InputError, match=r"a\.json: exists already; .*--overwrite"):
        Output(out)
    Output(out, overwrite=True).json({"a": 2})
    assert out.read_text() == '{\n  "a": 2\n}\n'
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_what_came_to_exist_meanwhile_is_not_overwritten_either(tmp_path: Path) -> None:
    place = Output(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_text("another's")
    with pytest.raises(InputError, match="came to exist"):
        place.text("mine")
    assert (tmp_path / "a.txt").read_text() == "another's"


@pytest.mark.parametrize("way", ["itself", "link", "other spelling", "sidecar"])
def test_an_input_is_never_replaced_whatever_it_is_called(tmp_path: Path, way: str) -> None:
    given, sidecar = tmp_path / "r.csv", tmp_path / "r.toml"
    given.write_text("t,u,y\n")
    sidecar.write_text("a = 1\n")
    link = tmp_path / "link.csv"
    link.symlink_to(given)
    (tmp_path / "d").mkdir()
    out = {"itself": given, "link": link, "other spelling": tmp_path / "d" / ".." / "r.csv", "sidecar": sidecar}[way]
    with pytest.raises(InputError, match="is read by this command"):
        Output(out, inputs=(given,), overwrite=True)
    with pytest.raises(InputError, match="is read by this command"):
        claim(out, inputs=(given,))
    assert given.read_text() == "t,u,y\n"
    assert sidecar.read_text() == "a = 1\n"


@pytest.mark.parametrize(
    "place", ["x" * 300, "a\0b", "file/a.json", "folder", "dangling", "/proc/a.json", "/dev/full/a.json"]
)
def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere" / "x")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError):
        Output(tmp_path / place)
    assert sorted(tmp_path.iterdir()) == before


def test_the_files_of_a_folder_come_together_or_not_at_all(tmp_path: Path) -> None:
    place = OutputFolder(tmp_path / "out", ("a.json", "b.html"))
    with pytest.raises(RuntimeError), place.write_all() as folder:  # noqa: PT012 - it stops between two files
        (folder / "a.json").write_text("1")
        raise RuntimeError("stopped between two files")
    assert list((tmp_path / "out").iterdir()) == []
    with place.write_all() as folder:
        (folder / "a.json").write_text("1")
        (folder / "b.html").write_text("2")
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"a.json", "b.html"}
    with pytest.raises(InputError, match=r"a\.json: exists already"):
        OutputFolder(tmp_path / "out", ("a.json", "b.html"))


def test_what_is_refused_after_its_place_was_claimed_leaves_no_folder(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    one, several = Output(tmp_path / "new" / "deep" / "a.json"), OutputFolder(tmp_path / "there" / "out", ("b.json",))
    assert [file.name for file in tmp_path.rglob("*")] == ["there"]
    one.json({})
    with several.write_all() as folder:
        (folder / "b.json").write_text("1")
    assert (tmp_path / "new" / "deep" / "a.json").exists()
    assert (tmp_path / "there" / "out" / "b.json").exists()


def test_a_result_that_is_not_finite_is_no_result(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not finite"):
        write_json(tmp_path / "a.json", {"K": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_a_device_is_written_to_and_a_full_one_is_one_line(tmp_path: Path) -> None:
    Output(Path("/dev/null")).text("away")
    with pytest.raises(InputError, match=r"/dev/full: cannot be written \(No space left on device\)"):
        Output(Path("/dev/full")).text("lost")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield a file system of 100 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", str(place)]
    if os.name != "posix" or os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a file system of 100 kB needs root and the right to mount")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_full_disk_leaves_the_file_that_was_there(small_disk: Path) -> None:
    write_whole(small_disk / "a.json", "before")
    (small_disk / "filler").write_bytes(b"x" * 60_000)
    with pytest.raises(OSError, match="No space left"):
        write_whole(small_disk / "a.json", "y" * 80_000)
    assert (small_disk / "a.json").read_text() == "before"
    assert {file.name for file in small_disk.iterdir()} == {"a.json", "filler"}


def test_a_disk_that_fills_leaves_no_half_line_in_a_recording_and_more_can_be_written_later(small_disk: Path) -> None:
    (small_disk / "filler").write_bytes(b"x" * 60_000)
    writer = RecordingWriter(small_disk / "r.csv", ("t", "u", "y"))
    rows = 0
    with pytest.raises(OSError, match="No space left"):  # noqa: PT012 - the row at which it is full is not known
        while True:
            writer.append((rows / 7, 1 / 3, 2 / 3))
            rows += 1
    recording = read_recording(small_disk / "r.csv")
    assert len(recording) == rows
    (small_disk / "filler").unlink()
    writer.append((rows / 7, 1 / 3, 2 / 3))
    writer.close()
    assert len(read_recording(small_disk / "r.csv")) == rows + 1


def test_a_line_is_appended_whole_or_not_at_all(tmp_path: Path) -> None:
    with open("/dev/full", "ab", buffering=0) as full, pytest.raises(OSError, match="No space left"):
        append_whole(full, b"line\n")
    with open(tmp_path / "a", "ab", buffering=0) as file:
        append_whole(file, b"line\n")
    assert (tmp_path / "a").read_bytes() == b"line\n"


COMMANDS = {
    "schema": ["schema", "--out", "config.toml"],
    "margins": ["margins", "--model", "model.toml", "--controller", "c.toml", "--out", "c.toml"],
    "controller": ["controller", "--controller", "c.toml", "--out", "c.toml"],
    "design": ["design", "--model", "model.toml", "--out", "model.toml"],
    "design's controller": ["design", "--model", "model.toml", "--out", "d.json", "--controller", "model.toml"],
    "reduce": ["reduce", "--points", "points.json", "--out", "points.json"],
    "simulate": ["simulate", "--model", "model.toml", "r.csv", "--out", "r.csv"],
    "diagnose": ["diagnose", "--model", "diagnosis.json", "r.csv", "--out", "."],
    "identify frequency": ["identify", "frequency", "r.csv", "--out", "r.csv"],
    "identify delay": ["identify", "delay", "r.csv", "--out", "r.csv"],
    "identify closed-loop": ["identify", "closed-loop", "r.csv", "--out", "r.csv"],
    "watch": ["watch", "r.csv", "--out", "r.csv"],
    "tune": ["tune", "r.csv", "--points", "result.json", "--out", "."],
    "init": ["init", "config.toml", "--kind", "simulated", "--plant", "ball"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_replaces_its_input_or_another_file(tmp_path: Path, command: str) -> None:
    names = ("r.csv", "r.toml", "model.toml", "c.toml", "points.json", "config.toml", "result.json", "diagnosis.json")
    for name in names:
        (tmp_path / name).write_text(f"# {name}\n")
    done = autotune(*COMMANDS[command], cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    assert "is read by this command" in done.stderr or "exists already" in done.stderr
    assert {file.name for file in tmp_path.iterdir()} == set(names)
    assert all((tmp_path / name).read_text() == f"# {name}\n" for name in names)


def test_a_run_keeps_the_comments_of_a_configuration_that_lies_in_its_folder(tmp_path: Path) -> None:
    from autotune.config import load_config
    from autotune.pipeline.folder import may_store, store_config

    shutil.copy(Path(__file__).parents[2] / "configs" / "ball_sim.toml", tmp_path / "config.toml")
    before = (tmp_path / "config.toml").read_text()
    assert "#" in before
    config = load_config(tmp_path / "config.toml")
    may_store(config, tmp_path)
    store_config(config, tmp_path)
    assert (tmp_path / "config.toml").read_text() == before
    other = config.model_copy(update={"name": "another"})
    with pytest.raises(InputError, match="says something else"):
        may_store(other, tmp_path)
    store_config(other, tmp_path)  # as a resumed run may
    assert (tmp_path / "config-2.toml").read_text() == before
    assert load_config(tmp_path / "config.toml") == other


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a file just opened is closed later
@pytest.mark.parametrize("way", ["file", "folder", "whole"])
def test_an_interrupt_at_any_call_leaves_a_whole_file_or_none(tmp_path: Path, way: str) -> None:
    def writes(place: Path) -> None:
        if way == "file":
            Output(place / "new" / "a.json").json({"a": 1})
        elif way == "whole":
            write_json(place / "a.json", {"a": 1})
        else:
            with OutputFolder(place / "new", ["a.json"]).write_all() as part:
                (part / "a.json").write_text('{"a": 1}')

    def interrupted_at(number: int, place: Path) -> bool:
        """Give the process a Ctrl-C before or after the numbered call, where Python hears it; say whether it came."""
        calls = itertools.count()

        def heard(frame: FrameType, event: str, _: object) -> None:
            if event != "return" and frame.f_code.co_filename in WRITING and next(calls) == number:
                signal.raise_signal(signal.SIGINT)

        sys.setprofile(heard)
        try:
            writes(place)
        except KeyboardInterrupt:
            pass
        finally:
            sys.setprofile(None)
        return next(calls) > number

    for number in itertools.count():
        place = tmp_path / str(number)
        place.mkdir()
        came = interrupted_at(number, place)
        files = [file for file in place.rglob("*") if not file.is_dir()]
        assert [file.name for file in files] in ([], ["a.json"]), number
        assert all(json.loads(file.read_text()) == {"a": 1} for file in files)
        assert not list(place.rglob(".part-*")), number
        if not came:
            assert number > 10
            assert files
            break
