"""FMUs as models: built from source, simulated as their equations say, retuned, and refused in one line."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.diagnosis import diagnose
from autotune.equations import Drive, compile_model, simulate
from autotune.equations.black_box import BlackBox, from_function
from autotune.equations.files import read_any_model
from autotune.errors import InputError
from autotune.recording import Recording, write_recording
from tests.autotune.equations.fmu_build import build
from tests.autotune.equations.models import one_state

pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler: apt install gcc"
)
MODEL = """
name = "rig"
fmu = "rig.fmu"
[[input]]
column = "u"
[output]
value = "phi"
[parameters]
J = 0.05
c = 0.1
"""
EQUATIONS = one_state(
    "w", {"J": 0.05, "c": 0.1},
    state=[{"name": "x", "derivative": "w"}, {"name": "w", "derivative": "(u - c*w)/J"}],
)  # fmt: skip


def recorded(seed: int, *, J: float = 0.05, c: float = 0.1, high: float = np.inf, rows: int = 600) -> Recording:
    """Return the truth by its equations: the FMU's own code is not asked."""
    rng = np.random.default_rng(seed)
    t, u = np.arange(rows) * 0.02, np.repeat(rng.normal(0.0, 1.0, rows // 20), 20)
    compiled = compile_model(EQUATIONS)
    drive = Drive(t=t, inputs=np.minimum(u, high)[:, None])
    y = simulate(compiled, np.array([J, c]), drive, np.zeros((1, 2))).y
    return Recording(t=t, u=u, y=y + rng.normal(0.0, 0.02, rows), name=f"rec{seed}.csv")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("fmu")
    build(place)
    (place / "m.toml").write_text(MODEL)
    return place


@pytest.mark.parametrize(("kind", "fmi"), [(k, v) for k in ("CoSimulation", "ModelExchange") for v in (2, 3)])
def test_an_fmu_runs_as_its_equations_say(tmp_path: Path, kind: str, fmi: int) -> None:
    build(tmp_path, kind, fmi=fmi)
    (tmp_path / "m.toml").write_text(MODEL)
    box = read_any_model(tmp_path / "m.toml")
    assert isinstance(box, BlackBox)
    rec = recorded(1, rows=200)
    drive = Drive(t=rec.t, inputs=rec.u[:, None])
    compiled = compile_model(EQUATIONS)
    for values in ({"J": 0.05, "c": 0.1}, {"J": 0.08, "c": 0.2}):
        wanted = simulate(compiled, np.array(list(values.values())), drive, np.zeros((1, 2))).y
        np.testing.assert_allclose(box.simulation(values, drive), wanted, atol=2e-4)


@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_an_fmu_is_diagnosed_from_the_command_line(tmp_path: Path, fmi: int) -> None:
    folder = tmp_path / "fmu"
    folder.mkdir()
    build(folder, fmi=fmi)
    (folder / "m.toml").write_text(MODEL)
    limited = {seed: recorded(seed, J=0.06, high=0.6, rows=300) for seed in (2, 3)}
    for seed, recording in limited.items():
        write_recording(recording, tmp_path / f"rec{seed}.csv")
    run = CliRunner().invoke(
        app,
        ["diagnose", "--model", str(folder / "m.toml"), str(tmp_path / "rec2.csv"), str(tmp_path / "rec3.csv"),
         "--out", str(tmp_path / "out")],
    )  # fmt: skip
    assert run.exit_code == 0, run.output
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert found["verdict"] == "effect"
    assert [e["name"] for e in found["effects"]] == ["actuator.saturation"]
    assert found["effects"][0]["input"] == "u"
    assert found["effects"][0]["parameters"]["high"]["value"] == pytest.approx(0.6, abs=0.02)
    assert found["parameters"]["J"]["value"] == pytest.approx(0.06, rel=0.03)
    simulated = CliRunner().invoke(
        app,
        ["simulate", "--model", str(tmp_path / "out" / "extended_model.toml"), str(tmp_path / "rec2.csv"), "--out",
         str(tmp_path / "sim.csv")],
    )  # fmt: skip
    assert simulated.exit_code == 0, simulated.output
    y_sim = np.loadtxt(tmp_path / "sim.csv", delimiter=",", skiprows=1)[:, 1]
    assert np.std(y_sim - limited[2].y) < 0.03


def test_from_fmu_writes_a_model_file(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "made.toml"
    run = CliRunner().invoke(app, ["model", "from-fmu", str(folder / "rig.fmu"), "--out", str(out)])
    assert run.exit_code == 0, run.output
    box = read_any_model(out)
    assert isinstance(box, BlackBox)
    assert box.columns == ("u", "load")
    assert {p.name: p.value for p in box.parameters} == {"J": 0.05, "c": 0.1, "k": 1.0}


@pytest.mark.parametrize(
    ("change", "says"),
    [(("value = \"phi\"", "value = \"psi\""), "no variable 'psi'"), (("J = 0.05", "mass = 1.0"), "no parameter 'mass'"),
     (('column = "u"', 'column = "voltage"'), "no input 'voltage'"), (("rig.fmu", "other.fmu"), "no such file")],
)  # fmt: skip
def test_what_an_fmu_does_not_have_is_one_line(folder: Path, change: tuple[str, str], says: str) -> None:
    (folder / "wrong.toml").write_text(MODEL.replace(*change))
    with pytest.raises(InputError, match=says) as refused:
        read_any_model(folder / "wrong.toml")
    assert "\n" not in str(refused.value)


def test_an_fmu_for_another_platform_is_one_line(folder: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(folder / "rig.fmu") as old, zipfile.ZipFile(tmp_path / "rig.fmu", "w") as new:
        new.writestr("modelDescription.xml", old.read("modelDescription.xml"))
        new.writestr("binaries/win64/rig.dll", b"")
    (tmp_path / "m.toml").write_text(MODEL)
    with pytest.raises(InputError, match="was built for win64"):
        read_any_model(tmp_path / "m.toml")
    (tmp_path / "rig.fmu").write_bytes(b"no archive")
    with pytest.raises(InputError, match="no FMU that can be read"):
        read_any_model(tmp_path / "m.toml")


@pytest.mark.parametrize(("kind", "fmi"), [(k, v) for k in ("CoSimulation", "ModelExchange") for v in (2, 3)])
def test_compiled_code_that_cannot_be_loaded_is_said_to_be_so(tmp_path: Path, kind: str, fmi: int) -> None:
    whole = build(tmp_path, kind, fmi=fmi).rename(tmp_path / "whole.fmu")
    (tmp_path / "m.toml").write_text(MODEL)
    r = recorded(1, rows=100)
    drive = Drive(t=r.t, inputs=r.u[:, None])
    for left, says in ((0, "file too short"), (1000, "it is damaged|file too short"), (None, "it is missing")):
        with zipfile.ZipFile(whole) as old, zipfile.ZipFile(tmp_path / "rig.fmu", "w") as new:
            for name in old.namelist():
                content = old.read(name)
                if not name.startswith("binaries"):
                    new.writestr(name, content)
                elif left is None:
                    new.writestr(str(Path(name).with_name("another.so")), content)
                else:
                    new.writestr(name, content[:left])
        box = read_any_model(tmp_path / "m.toml")
        assert isinstance(box, BlackBox)
        with pytest.raises(InputError, match=f"cannot be loaded .*({says})") as refused:
            box.simulation({"J": 0.05, "c": 0.1}, drive)
        assert refused.value.remedy == "copy or export the FMU again, or install the library that it needs"


def test_a_step_function_is_retuned_like_any_model() -> None:
    def step(x, inputs, p, dt):  # type: ignore[no-untyped-def]
        lost = np.exp(-dt / p["T"])
        return lost * x + (1.0 - lost) * p["K"] * inputs[0], x

    box = from_function(step, 0.0, {"K": 2.0, "T": 0.5})
    t = np.arange(400) * 0.05
    u = np.repeat(np.random.default_rng(4).normal(0.0, 1.0, 20), 20)
    y = box.simulation({"K": 2.5, "T": 0.4}, Drive(t=t, inputs=u[:, None]))
    noisy = y + np.random.default_rng(5).normal(0.0, 0.01, 400)
    found = diagnose(box, [Recording(t=t, u=u, y=noisy)])
    assert found.verdict == "parameters"
    np.testing.assert_allclose(found.search.found.chosen.outcome.fitted.parameters, [2.5, 0.4], rtol=0.02)
