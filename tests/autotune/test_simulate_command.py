"""The command that runs a model: what it says of where the model was fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app

MODEL = """
[input]
recorded = [-1.0, 1.0]
[[block]]
num = [2.0]
den = [0.5, 1.0]
"""


@pytest.mark.parametrize(("size", "warns"), [(1.0, False), (3.0, True)])
def test_a_model_that_runs_outside_what_it_was_fitted_to_says_so(tmp_path: Path, size: float, warns: bool) -> None:
    t = 0.05 * np.arange(400)
    u = size * np.sign(np.sin(0.8 * t) + 1e-9)
    table = np.column_stack([t, u, 0.0 * t])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="t,u,y", comments="")
    (tmp_path / "m.toml").write_text(MODEL)
    given = ["simulate", str(tmp_path / "r.csv"), "--model", str(tmp_path / "m.toml"), "--out", str(tmp_path / "s.csv")]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0
    assert ("u leaves what the model was fitted to (-1 to 1) in 1e+02 % of the rows" in result.stderr) is warns
