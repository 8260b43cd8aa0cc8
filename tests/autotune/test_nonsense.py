"""What makes no sense is refused in one line, before it takes memory and before it reaches a rig."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import autotune as at
from autotune.batch.campaign import REPORT, RESULTS, Campaign
from autotune.batch.settings import CampaignSettings
from autotune.config import load_config
from autotune.diagnosis import diagnose
from autotune.equations.expressions import parse
from autotune.errors import InputError
from autotune.files.workbook import open_table
from autotune.identification.delay.tracking import track
from autotune.models import Block, Model, Port, TransferFunction
from autotune.pipeline.audit import audit_log
from autotune.recorded_units import require_units_of_model
from autotune.recording import Recording, read_recording
from tests.autotune.command import autotune

ROOT = Path(__file__).parents[2]
BALL = (ROOT / "configs" / "ball_sim.toml").read_text()


@pytest.mark.parametrize("value", ["true", '"0.02"', "[0.02]"])
def test_a_number_of_another_type_is_none(tmp_path: Path, value: str) -> None:
    lines = [f"sample_time_s = {value}" if line.startswith("sample_time_s") else line for line in BALL.splitlines()]
    (tmp_path / "c.toml").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"signals\.sample_time_s.*valid number"):
        load_config(tmp_path / "c.toml")


@pytest.mark.parametrize(
    ("written", "said"),
    [
        (
            {"[operating_point]": "[operating_point]\nplant_sign = true"},
            r"operating_point\.plant_sign = True: ",
        ),
        ({"noise = 0.35": "noise = 1e308"}, r"rig\.noise = 1e\+308 is more than the 8 between limits\.y_min and y_max"),
        ({"K = -0.01": "K = 1e15"}, r"controller: K = 1e\+15 moves the command through its whole range, .* of 1e-14"),
        ({"K = -0.01": "K = -0.05", "Ti_s = 6.0": "Ti_s = 1e-6"}, r"controller: K / T_I = .* within one sample for"),
        ({"Ti_s = 6.0": "Ti_s = 1e-6"}, r"controller: K / T_I = -1e\+04 per s moves .* within one sample for"),
    ],
)
def test_what_a_rig_has_is_what_its_ranges_can_mean(tmp_path: Path, written: dict[str, str], said: str) -> None:
    text = BALL
    for before, after in written.items():
        assert before in text
        text = text.replace(before, after)
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(InputError, match=said):
        load_config(tmp_path / "c.toml")


@pytest.mark.parametrize("gains", ["K = 1e15\nTi_s = 1e-6\n", "K = 0.02\nTi_s = 3.6\n"])
def test_gains_that_are_refused_leave_no_folder(tmp_path: Path, gains: str) -> None:
    (tmp_path / "c.toml").write_text(f'kind = "pi"\n{gains}')
    words = ["deploy", ROOT / "configs" / "ball_sim.toml", "--controller", "c.toml", "--no-verify", "--yes"]
    done = autotune(*words, "--out", "new/o", cwd=tmp_path)
    assert done.returncode == 2
    assert "nothing was written" in done.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["c.toml"]


def test_samples_closer_than_any_clock_tells_apart_are_refused(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("t,u,y\n0,1,2\n1e-9,2,3\n1.0000001e-9,2,3\n")
    with pytest.raises(InputError, match=r"r\.csv: data rows 2 and 3 are 1e-16 s apart, .*; write t in seconds"):
        read_recording(tmp_path / "r.csv")


def test_a_gap_of_years_takes_no_memory() -> None:
    t = np.concatenate([np.arange(200.0) * 0.01, [1e6]])
    recording = Recording(t=t, u=np.sin(t), y=np.cos(t), name="r.csv")
    with pytest.raises(InputError, match=r"r\.csv: an even grid of 0\.01 s needs 1e\+08 rows.*cut the recording"):
        recording.resampled(0.01)


def test_a_recording_that_is_nearly_all_gap_is_not_simulated_through_it() -> None:
    """One wrong date in a file: a diagnosis ran for minutes."""
    t = np.arange(400.0)
    t[200:] += 1e6
    rng = np.random.default_rng(1)
    recording = Recording(t=t, u=rng.normal(size=400), y=rng.normal(size=400), name="r.csv")
    lag = Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(9.0, 1.0)))
    model = Model(name="lag", input=Port(), output=Port(), blocks=(lag,))
    with pytest.raises(InputError, match=r"r\.csv: 400 rows in a time .* 1e\+06 s; cut the recording at the gap"):
        diagnose(model, [recording])


@pytest.mark.parametrize(
    ("sidecar", "said"),
    [
        ('hold = "first"', "hold = 'first'"),
        ('[[block]]\nname = "a"', "is a model"),
        ("sample_time_s = 0.1", r"r\.toml: sample_time_s = 0\.1, and the rows of r\.csv are 1 s apart; correct"),
        ("sample_time_s = 1.5", "rows of r.csv are 1 s apart"),
        ("sample_time_s = true", "sample_time_s = True"),
        ("[units]\nu = 5", "no text"),
    ],
)
def test_a_sidecar_that_is_none_is_refused(tmp_path: Path, sidecar: str, said: str) -> None:
    (tmp_path / "r.csv").write_text("t,u,y\n0,1,2\n1,2,3\n")
    (tmp_path / "r.toml").write_text(sidecar)
    with pytest.raises(InputError, match=said):
        read_recording(tmp_path / "r.csv")


def test_a_sample_time_that_rows_of_a_slow_link_do_not_keep_is_believed(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("t,u,y\n0,1,2\n1.5,2,3\n3,2,3\n")
    (tmp_path / "r.toml").write_text("sample_time_s = 1")
    assert read_recording(tmp_path / "r.csv").sample_time_s == 1.5


CHAIN = Model(
    name="lag", input=Port(unit="V"), output=Port(unit="Pa"),
    blocks=(Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(9.0, 1.0))),),
)  # fmt: skip


def recorded_in(**units: str) -> Recording:
    t = np.arange(5.0)
    return Recording(t=t, u=t, y=t, metadata={"units": units}, name="r.csv")


@pytest.mark.parametrize(
    ("units", "said"),
    [
        ({"u": "mV"}, r"r\.csv: u is in mV, and in V in the model 'lag': a factor of 0\.001; convert"),
        ({"u": "V", "y": "kPa"}, "y is in kPa, and in Pa in the model 'lag': a factor of 1000"),
        ({"y": "degC"}, "y is in degC, and in Pa in the model 'lag': which do not convert"),
    ],
)
def test_units_of_a_recording_and_of_a_model_are_compared(units: dict[str, str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        at.simulate(CHAIN, recorded_in(**units))
    with pytest.raises(InputError, match=said):
        at.diagnose(CHAIN, recorded_in(**units))


def test_units_that_say_the_same_or_nothing_are_no_contradiction() -> None:
    alike: list[dict[str, str]] = [{}, {"u": "", "y": "Pa"}, {"u": "volt", "y": "N/m^2"}, {"u": "scoops"}, {"x": "A"}]
    require_units_of_model(CHAIN, [recorded_in(**units) for units in alike])


def test_units_of_recordings_taken_together_are_compared(tmp_path: Path) -> None:
    for name, unit in (("a", "V"), ("b", "mV")):
        rows = "".join(f"{t},{t % 3},{t % 5}\n" for t in range(200))
        (tmp_path / f"{name}.csv").write_text(f"t,u,y\n{rows}")
        (tmp_path / f"{name}.toml").write_text(f'[units]\ny = "{unit}"\n')
    line = ["identify", "frequency", "a.csv", "b.csv", "--out", "p.json"]
    done = autotune(*line, cwd=tmp_path)
    assert done.returncode == 2
    assert "b.csv: y is in mV, and in V in a.csv: a factor of 0.001" in done.stderr


@pytest.mark.parametrize("cell", ["XFD1048576", "A99999999999999999999"])
def test_a_stray_cell_far_from_the_table_takes_no_memory(tmp_path: Path, cell: str) -> None:
    with zipfile.ZipFile(tmp_path / "r.xlsx", "w") as book:
        book.writestr(
            "xl/worksheets/sheet1.xml",
            f'<worksheet><row r="1"><c r="A1"><v>1</v></c><c s="1" r="{cell}"><v>1</v></c></row></worksheet>',
        )
    with pytest.raises(InputError, match=r"sheet1\.xml reaches to row .* stray cell"):
        open_table(tmp_path / "r.xlsx")


def test_parquet_columns_of_lists_are_left_out_and_texts_that_are_none_are_refused(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet

    numbers = [0.0, 1.0, 2.0]
    pyarrow.parquet.write_table(pa.table({"t": numbers, "l": [[1]] * 3, "y": numbers}), tmp_path / "l.parquet")
    assert open_table(tmp_path / "l.parquet").names == ("t", "y")
    wrong = pa.Array.from_buffers(
        pa.utf8(), 1, [None, pa.py_buffer(np.array([0, 2], np.int32)), pa.py_buffer(b"\xff\xfe")]
    )
    pyarrow.parquet.write_table(pa.table({"t": [1.0], "w": wrong}), tmp_path / "w.parquet")
    with pytest.raises(InputError, match="cannot be read"):
        open_table(tmp_path / "w.parquet").load(["w"])


def test_a_cell_longer_than_any_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text('a;u;y\n0;1;2\n1;2;3\n2;"' + "x" * 200_000 + "\n")
    with pytest.raises(InputError, match="cannot be parted"):
        open_table(tmp_path / "r.csv").load(["a"])


def test_a_campaign_does_not_replace_what_is_not_its_own(tmp_path: Path) -> None:
    work = Campaign(settings=CampaignSettings(name="c", task="identify"), loops=(), out=tmp_path)
    for name in (REPORT, RESULTS):
        (tmp_path / name).write_text("another's")
        with pytest.raises(InputError, match=f"holds {name}, which is not a campaign's"):
            work.claim()
        (tmp_path / name).unlink()
    work.claim()
    (tmp_path / REPORT).write_text("its own")
    work.claim()


def test_nothing_is_appended_to_a_file_that_is_no_audit_log(tmp_path: Path) -> None:
    config = load_config(ROOT / "configs" / "ball_sim.toml")
    (tmp_path / "notes.txt").write_text("my notes\n")
    with pytest.raises(InputError, match=r"notes\.txt: is not an audit log"):
        audit_log(config.model_copy(update={"audit_log": str(tmp_path / "notes.txt")}), tmp_path, "deploy")
    (tmp_path / "audit.jsonl").write_text('{"at": "1", "who": "a", "rig": "b", "verdict": "kept"}\n')
    audit_log(config, tmp_path, "deploy")


OPTIONS = {
    "--modulus-margin": ["watch", "r.csv", "--modulus-margin", "-1", "--out", "o.csv"],
    "--phase-margin": ["watch", "r.csv", "--phase-margin", "-5", "--out", "o.csv"],
    "unknown effect 'plant.leek'; did you mean 'plant.leak'": ["prove", "--without", "plant.leek", "--out", "o"],
    "--follow": ["watch", "r.csv", "--follow", "nan", "--out", "o.csv"],
    "--noise-frequency": ["tune", "r.csv", "--noise-frequency", "inf", "--out", "o"],
    "noise_gain": ["tune", "r.csv", "--noise-gain", "-1", "--out", "o"],
    "phase_margin_deg": ["tune", "r.csv", "--phase-margin", "91", "--out", "o"],
}


@pytest.mark.parametrize("named", OPTIONS)
def test_an_option_beyond_its_range_is_one_line_that_names_it(tmp_path: Path, named: str) -> None:
    done = autotune(*OPTIONS[named], cwd=tmp_path)
    assert done.returncode == 2
    assert named in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


LAG = '[[block]]\nname = "p"\nplace = "plant"\nnum = [2.0]\nden = [1.0, {last}]\n'


@pytest.mark.parametrize(
    ("num", "options", "said"),
    [
        ("[2.0]", ["--noise-frequency", "-1"], "noise frequency = -1; it must be a positive frequency in rad/s"),
        ("[0.0]", [], "m.toml [[block]] 1: num is 0: nothing comes through this block; write its gain"),
    ],
)
def test_margins_of_nothing_are_refused(tmp_path: Path, num: str, options: list[str], said: str) -> None:
    (tmp_path / "m.toml").write_text('name = "lag"\n' + LAG.format(last=1.0).replace("[2.0]", num))
    (tmp_path / "c.toml").write_text('kind = "pi"\nK = 0.5\nTi_s = 1.0\n')
    done = autotune("margins", "--model", "m.toml", "--controller", "c.toml", *options, "--out", "o", cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert sorted(file.name for file in tmp_path.iterdir()) == ["c.toml", "m.toml"]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--sample-time", "-1"], "signals.sample_time_s = -1"),
        (["--u-range", "10", "0"], "u_min"),
        (["--u-safe", "99"], "u_safe"),
        (["--y", "99"], "operating_point.y = 99"),
        (["--u", "99"], "operating_point.u_guess = 99"),
        (["--y-range", "5", "5"], "y_min"),
    ],
)
def test_what_is_said_of_a_simulated_plant_counts(tmp_path: Path, flags: list[str], said: str) -> None:
    """The flags were passed over, and a configuration written without them."""
    done = autotune("init", "rig.toml", "--kind", "simulated", "--plant", "ball", *flags, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


REFERENCES = {
    "u_rate = 0": ["--u-rate", "0"],
    "y_speed = -1": ["--y-speed", "-1"],
    "--sample-time": ["--sample-time", "0"],
    "rows of": ["--sample-time", "1e-6", "--u-rate", "1e-3"],
}


@pytest.mark.parametrize("named", REFERENCES)
def test_a_reference_of_no_limit_or_too_many_rows_is_refused(tmp_path: Path, named: str) -> None:
    (tmp_path / "m.toml").write_text('name = "lag"\n' + LAG.format(last=1.0))
    line = ["reference", "--model", "m.toml", "--u-min", "-3", "--u-max", "3", "--out", "r.csv", *REFERENCES[named]]
    done = autotune(*line, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert named in done.stderr
    assert done.stderr.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["m.toml"]


@pytest.mark.parametrize(("last", "warned"), [(1.0, False), (-1.0, True)])
def test_a_command_computed_for_an_unstable_plant_is_said_to_need_a_controller(
    tmp_path: Path, last: float, warned: bool
) -> None:
    (tmp_path / "m.toml").write_text('name = "lag"\n' + LAG.format(last=last))
    line = ["reference", "--model", "m.toml", "--u-min", "-3", "--u-max", "3", "--out", "r.csv"]
    done = autotune(*line, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert ("the plant is unstable" in done.stderr) == warned


@pytest.mark.parametrize(("expression", "said"), [("1/0", "division by zero"), ("x/1e999", "no number holds this")])
def test_an_expression_that_has_no_value_is_refused_where_it_is_read(expression: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse(expression)


def points_of(frequencies: list[float], sd: float) -> str:
    response = [2.0 / (1j * w + 1.0) for w in frequencies]
    entries = [
        {"omega_rad_s": w, "gain": abs(g), "phase_deg": float(np.degrees(np.angle(g))), "cov": [[sd**2, 0], [0, sd**2]]}
        for w, g in zip(frequencies, response, strict=True)
    ]
    return json.dumps({"points": entries})


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (points_of([0.5, 1.0, 2.0, 4.0], 0.0), "cov is zero"),
        (points_of([1.0] * 5, 0.01), "5 points at 1 frequency"),
    ],
)
@pytest.mark.parametrize("command", ["design", "tune", "reduce"])
def test_points_on_which_no_design_can_rest_are_refused(tmp_path: Path, command: str, points: str, said: str) -> None:
    (tmp_path / "p.json").write_text(points)
    done = autotune(command, "--points", "p.json", "--out", "o", cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["p.json"]
    given = at.frequency_points(tmp_path / "p.json")
    with pytest.raises(InputError, match=said):
        (at.reduce if command == "reduce" else at.tune)(given)


@pytest.mark.parametrize(
    ("key", "value"), [("gain", True), ("gain", "2"), ("phase_deg", "-90"), ("cov", [["1", 0], [0, 1]])]
)
def test_points_of_texts_and_truths_are_refused(tmp_path: Path, key: str, value: object) -> None:
    points = json.loads(points_of([0.5, 1.0, 2.0, 4.0], 0.01))
    points["points"][1][key] = value
    (tmp_path / "p.json").write_text(json.dumps(points))
    with pytest.raises(InputError, match=r"p\.json points\[1\]: needs .* as numbers"):
        at.frequency_points(tmp_path / "p.json")


def test_windows_that_lie_in_a_gap_are_told_and_do_not_end_the_watch() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(600.0)
    u = np.repeat(rng.choice([-1.0, 1.0], 30), 20)
    y = lfilter([0.1], [1.0, -0.9], np.roll(u, 2)) + 0.01 * rng.standard_normal(t.size)
    recording = Recording(t=np.where(t < 300, t, t + 2000.0), u=u, y=y, name="r.csv")
    windows = list(track(recording, 1, window_s=200.0, every_s=100.0, max_delay_s=10.0))
    assert [one.reason for one in windows if 600.0 < one.end_s < 2200.0] == ["no rows in it: a gap"] * 15
    assert windows[0].model is not None
    assert windows[-1].model is not None
    with pytest.raises(InputError, match=r"a window every 1e-06 s on 2599 s makes 2\.6e\+09 of them"):
        next(track(recording, 1, window_s=200.0, every_s=1e-6))


def test_a_name_neither_breaks_the_page_nor_turns_its_text(tmp_path: Path) -> None:
    from autotune.report.page import Page, write_page

    page = Page(title="@CHARTS@ @PLOTLY@ @BODY@", tone="good", verdict="a\u202eb", summary=("\x1b[31m",))
    write_page(page, tmp_path / "p.html")
    text = (tmp_path / "p.html").read_text()
    assert len(text) < 50_000
    assert "<title>@CHARTS@ @PLOTLY@ @BODY@</title>" in text
    assert "a\\u202eb" in text
    assert "\\x1b[31m" in text
