"""The command that puts the diagnosis to the proof: what it refuses."""

import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.errors import InputError

CLEAN = 60  # a seed whose case conceals nothing


def test_an_ablation_without_a_case_of_the_effect_is_refused(tmp_path):
    words = ["prove", "--out", str(tmp_path), "--cases", "1", "--seed", str(CLEAN), "--without", "plant.leak"]
    with pytest.raises(InputError, match=r"plant\.leak"):
        CliRunner().invoke(app, words, catch_exceptions=False)
    assert len((tmp_path / "seal.txt").read_text().strip()) == 64  # published before anything is diagnosed


def test_answers_that_were_exchanged_after_sealing_are_refused(tmp_path):
    words = ["prove", "--out", str(tmp_path), "--cases", "1", "--seed", str(CLEAN), "--without", "plant.leak"]
    (tmp_path / "seal.txt").write_text("0" * 64 + "\n")
    with pytest.raises(InputError, match="sealed"):
        CliRunner().invoke(app, words, catch_exceptions=False)


def test_recordings_and_an_ablation_exclude_each_other(tmp_path):
    words = ["prove", "--out", str(tmp_path / "out"), "--recordings", str(tmp_path), "--without", "plant.leak"]
    with pytest.raises(InputError, match="--recordings"):
        CliRunner().invoke(app, words, catch_exceptions=False)


def test_a_folder_without_a_rig_is_refused(tmp_path):
    words = ["prove", "--out", str(tmp_path / "out"), "--recordings", str(tmp_path)]
    with pytest.raises(InputError, match=r"model\.toml"):
        CliRunner().invoke(app, words, catch_exceptions=False)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["simulated", "recorded"])
def test_a_scheduler_that_is_none_is_refused_before_cases_are_made(tmp_path, kind):
    words = ["prove", "--out", str(tmp_path / "out"), "--cases", "1", "--scheduler", "nonsense"]
    if kind == "recorded":
        words += ["--recordings", str(tmp_path)]
    with pytest.raises(InputError, match="nonsense: no scheduler answers"):
        CliRunner().invoke(app, words, catch_exceptions=False)
    assert not (tmp_path / "out").exists()
