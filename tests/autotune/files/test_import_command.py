"""``autotune import``, and commands on files with other names of their columns."""

from __future__ import annotations

from importlib import metadata

import numpy as np
import pytest
from typer.testing import CliRunner

import autotune
from autotune.cli import app
from autotune.errors import InputError
from autotune.recording import read_recording

N = 900


@pytest.fixture
def trace(tmp_path):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.choice([45.0, 55.0], N // 30), 30)
    y, x = np.empty(N), 0.0
    for k in range(N):
        y[k] = 60.0 + x + rng.normal(0.0, 0.02)
        x += 0.05 * (0.8 * (u[k] - 50.0) - x)
    path = tmp_path / "trace.csv"
    rows = [f"{k};{a:.2f};{b:.3f};{c:.1f}".replace(".", ",") for k, (a, b, c) in enumerate(zip(y, y, u, strict=True))]
    path.write_text("\n".join(["Zeit;Kanal A;Kanal B;Kanal C", ";°C;°C;%", *rows]))
    return path


def call(*words):
    return CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False, standalone_mode=False)


def test_import_writes_the_projects_form_and_says_where_it_came_from(trace, tmp_path):
    out = tmp_path / "oven.csv"
    done = call("import", trace, "--u", "Kanal C", "--y", "kanal b", "--out", out)
    assert "semicolons between cells, decimal comma" in done.output
    recording = read_recording(out)
    assert len(recording) == N
    assert recording.metadata["units"]["u"] == "%"
    assert recording.metadata["file"]["columns"]["y"] == "Kanal B"
    with pytest.raises(InputError, match="exists already"):
        call("import", trace, "--u", "Kanal C", "--y", "Kanal B", "--out", out)


def test_a_command_refuses_what_it_is_not_sure_of_and_takes_names(trace, tmp_path):
    words = ("identify", "delay", trace, "--order", "1", "--out", tmp_path / "delay.json")
    with pytest.raises(InputError, match=r"--u .* --y .* autotune import"):
        call(*words)
    assert "delay" in call(*words, "--u", "Kanal C", "--y", "Kanal B").output


def test_the_version_is_the_packages() -> None:
    assert call("--version").output == f"relay-autotune {autotune.__version__}\n"
    assert autotune.__version__ == metadata.version("relay-autotune")
