"""Campaigns: what they refuse, what a loop's row says, what is done again, and that workers do not matter."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from autotune.batch.campaign import RESULTS, Campaign, write_results
from autotune.batch.engine import run_all
from autotune.batch.loop import Work, analyse_loop
from autotune.batch.row import Row
from autotune.batch.settings import CampaignSettings, LoopSettings, read_campaign
from autotune.cli import app
from autotune.errors import InputError
from autotune.points import read_points
from tests.autotune.batch.plant_files import DEAD_TIME_S, GAIN, TAU_S, plant_file, signals, write

EXAMPLES = Path(__file__).resolve().parents[3] / "configs" / "campaigns"


def plant_folder(folder, task):
    """Return a campaign over two plants, one with four times the gain, and two recordings that fail."""
    plant_file(folder / "good.csv", 0)
    plant_file(folder / "hot.csv", 1, gain=4.0 * GAIN)
    (folder / "broken.csv").write_text("t,u,y\n0,1,2\n1,1,x\n")
    t, u, y = signals(2)
    write(folder / "still.csv", {"t": t, "u": 0.0 * u, "y": y})
    path = folder / "campaign.toml"
    path.write_text(
        f'name = "four"\ntask = "{task}"\nfolder = "*.csv"\n[design]\nnoise_gain = 10.0\n'
        "[defaults]\nK = 1.0\nTi_s = 2.0\n"
    )
    return path


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """Campaign that asks for designs, the folder of its results, and its rows; made without any cluster."""
    path = plant_folder(tmp_path_factory.mktemp("plant"), "design")
    out = tmp_path_factory.mktemp("alone")
    rows, _ = analysed(path, out)
    return path, out, rows


def analysed(path, out, client=None):
    settings, loops = read_campaign(path)
    campaign = Campaign(settings=settings, loops=loops, out=out)
    rows = campaign.done(print)
    works = campaign.works(rows, lambda name, share: None)
    found = run_all(client, analyse_loop, works) if client else ((n, analyse_loop(w)) for n, w in works.items())
    rows |= {name: campaign.keep(works[name].loop, finding) for name, finding in found}
    return write_results(rows.values(), out / RESULTS), list(works)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('name = "a"\n', "give the loops once"),
        ('name = "a"\nfolder = "*.csv"\nloops = "loops.csv"\n', "give the loops once"),
        ('name = "a"\nfolder = "nothing/*.csv"\n', r"no loop; nothing matches nothing/\*\.csv"),
        ('name = "a"\ntaks = "design"\nfolder = "*.csv"\n', "did you mean 'task'"),
        ('name = "a"\nloops = "twice.csv"\n', "'TIC1' is there twice"),
        ('name = "a"\nloops = "typo.csv"\n', r"typo\.csv line 2: unknown key 'y_scal'; did you mean 'y_scale'"),
        ('name = "a"\nloops = "gains.csv"\n', "K and Ti_s are given together"),
        ('name = "a"\ntask = "diagnose"\nloops = "right.csv"\n', "'TIC1' has no model"),
    ],
)
def test_a_campaign_that_cannot_be_meant_is_refused(tmp_path, text, said):
    (tmp_path / "c.toml").write_text(text)
    (tmp_path / "right.csv").write_text("name,file\nTIC1,a.csv\n")
    (tmp_path / "twice.csv").write_text("name,file\nTIC1,a.csv\nTIC1,b.csv\n")
    (tmp_path / "typo.csv").write_text("name,file,y_scal\nTIC1,a.csv,2\n")
    (tmp_path / "gains.csv").write_text("name,file,K,Ti_s\nTIC1,a.csv,2,\n")
    with pytest.raises(InputError, match=said):
        read_campaign(tmp_path / "c.toml")


def test_a_campaign_in_which_nothing_can_be_analysed_is_refused_and_leaves_the_reasons(tmp_path, scheduler):
    (tmp_path / "c.toml").write_text('name = "a"\n[[loop]]\nname = "TIC1"\nfile = "gone.csv"\n')
    arguments = ["batch", str(tmp_path / "c.toml"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*arguments, "--scheduler", scheduler])
    assert isinstance(done.exception, InputError)
    assert "no loop could be analysed" in str(done.exception)
    assert "failed  TIC1: " in done.output
    assert (tmp_path / "out" / "report.html").stat().st_size > 0


def test_a_scheduler_that_is_none_is_refused_before_anything_is_prepared(tmp_path):
    (tmp_path / "c.toml").write_text('name = "a"\n[[loop]]\nname = "TIC1"\nfile = "gone.csv"\n')
    words = ["batch", str(tmp_path / "c.toml"), "--out", str(tmp_path / "out"), "--scheduler", "nonsense"]
    done = CliRunner().invoke(app, words)
    assert isinstance(done.exception, InputError)
    assert "nonsense: no scheduler answers" in str(done.exception)
    assert not any((tmp_path / "out" / "loops").iterdir())


def test_what_needs_attention_comes_first_and_a_failing_loop_is_a_row_with_its_reason(designed):
    _, _, rows = designed
    assert [(row.loop, row.attention) for row in rows] == [
        ("hot", "act"),
        ("broken", "failed"),
        ("still", "failed"),
        ("good", "fine"),
    ]
    hot, broken, still, good = rows
    assert hot.modulus_now < 0.5 < hot.modulus
    assert "broken.csv line 3" in broken.reason
    assert "the command never changes" in still.reason
    assert good.modulus_now > 0.5
    assert good.K > 2.0 * hot.K  # the plant's gain is a quarter


def test_the_table_and_the_points_of_a_loop_can_be_gone_on_with(designed):
    _, out, rows = designed
    assert tuple(Row(**row) for row in pq.read_table(out / RESULTS).to_pylist()) == rows
    for point in read_points(out / "loops" / "good.json"):
        s = 1j * point.omega_rad_s
        truth = GAIN * np.exp(-s * DEAD_TIME_S) / (1.0 + s * TAU_S)
        assert abs(point.response - truth) < 6.0 * math.sqrt(np.trace(point.covariance)) + 0.01 * abs(truth)


def test_results_do_not_depend_on_the_workers(designed, tmp_path, two_workers):
    path, alone, _ = designed
    analysed(path, tmp_path, two_workers)
    for name in (RESULTS, "loops/good.json", "loops/hot.json", "loops/broken.json"):
        assert (alone / name).read_bytes() == (tmp_path / name).read_bytes()


def test_the_command_runs_a_campaign_on_an_existing_scheduler_and_continues_it(designed, tmp_path, scheduler):
    path, alone, _ = designed
    words = ["batch", str(path), "--out", str(tmp_path), "--scheduler", scheduler]
    said = CliRunner().invoke(app, words, catch_exceptions=False)
    assert "Of 4 loops, 1 needs action, 2 could not be analysed, 1 is fine." in said.output
    assert (alone / RESULTS).read_bytes() == (tmp_path / RESULTS).read_bytes()
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.index(">hot</span>") < page.index(">broken</span>") < page.index(">good</span>")
    again = CliRunner().invoke(app, words, catch_exceptions=False)
    assert "4 of 4 loops are done already" in again.output


def test_only_what_is_missing_or_was_asked_otherwise_is_done_again(tmp_path):
    out, path = tmp_path / "out", plant_folder(tmp_path, "identify")
    rows, done = analysed(path, out)
    assert sorted(done) == ["broken", "good", "hot", "still"]
    assert analysed(path, out) == (rows, [])
    (out / "loops" / "hot.json").unlink()
    plant_file(tmp_path / "broken.csv", 3)
    cut_off = out / "loops" / "still.json"
    cut_off.write_text(cut_off.read_text()[:100])
    again, done = analysed(path, out)
    assert sorted(done) == ["broken", "hot", "still"]
    assert {row.loop: row.attention for row in again} == {row.loop: row.attention for row in rows} | {"broken": "fine"}
    path.write_text(path.read_text().replace("Ti_s = 2.0", "Ti_s = 2.5"))
    assert sorted(analysed(path, out)[1]) == ["broken", "good", "hot", "still"]


DAMAGE = {
    "cut off": lambda text: text[: len(text) // 2],
    "empty": lambda text: "",
    "not text": lambda text: "\udcff\udcfe" + text,
    "nested without end": lambda text: "[" * 100_000,
    "a list": lambda text: "[]",
    "no row": lambda text: text.replace('"row"', '"wor"'),
    "a key that no row has": lambda text: text.replace('"u_unit"', '"unit"'),
    "a word for a number": lambda text: text.replace('"severity": 0.0', '"severity": "x"'),
    "no severity": lambda text: text.replace('"severity": 0.0', '"severity": null'),
    "not a number": lambda text: text.replace('"severity": 0.0', '"severity": NaN'),
    "beyond all numbers": lambda text: text.replace('"severity": 0.0', '"severity": 1e999'),
    "of too many digits": lambda text: text.replace('"severity": 0.0', f'"severity": {"9" * 5000}'),
    "half a row": lambda text: text.replace('"pieces": 1', '"pieces": 1.5'),
    "an unknown attention": lambda text: text.replace('"attention": "fine"', '"attention": "later"'),
    "points that are none": lambda text: text.replace('"points": [', '"points": [7, '),
}  # fmt: skip


def test_whatever_damaged_the_file_of_a_loop_is_said_in_a_line_and_the_loop_done_again(tmp_path, capsys):
    plant_file(tmp_path / "good.csv", 0)
    (tmp_path / "campaign.toml").write_text('name = "one"\ntask = "identify"\nfolder = "*.csv"\n')
    rows, _ = analysed(tmp_path / "campaign.toml", tmp_path / "out")
    file = tmp_path / "out" / "loops" / "good.json"
    whole = file.read_text()
    settings, loops = read_campaign(tmp_path / "campaign.toml")
    campaign = Campaign(settings=settings, loops=loops, out=tmp_path / "out")
    for kind, damage in DAMAGE.items():
        assert damage(whole) != whole, kind
        file.write_text(damage(whole), errors="surrogateescape")
        assert campaign.done(print) == {}, kind
        assert capsys.readouterr().out == f"{file}: is damaged; the loop is done again\n", kind
    assert analysed(tmp_path / "campaign.toml", tmp_path / "out") == (rows, ["good"])
    assert file.read_text() == whole


def test_a_folder_in_the_place_of_a_loops_file_is_refused_before_the_work(tmp_path):
    plant_file(tmp_path / "good.csv", 0)
    (tmp_path / "campaign.toml").write_text('name = "one"\ntask = "identify"\nfolder = "*.csv"\n')
    (tmp_path / "out" / "loops" / "good.json").mkdir(parents=True)
    with pytest.raises(InputError, match=r"good\.json: cannot be written \(Is a directory\)"):
        analysed(tmp_path / "campaign.toml", tmp_path / "out")


def test_tags_of_a_wide_export_give_what_the_recording_itself_gives(tmp_path):
    t, u, y = signals(0)
    stamps = [f"2024-02-01T00:{int(s // 60):02d}:{s % 60:06.3f}" for s in t]
    rows = [f"{s},{a:.9f},{(b - 20) * 10:.8f},{b:.9f}" for s, a, b in zip(stamps, u, y, strict=True)]
    (tmp_path / "export.csv").write_text("\n".join(["time,A.OP,A.PV,B.PV", *rows]) + "\n")
    (tmp_path / "loops.csv").write_text(
        "name,file,u,y,y_scale,y_offset\nA/raw,export.csv,A.OP,A.PV,0.1,20\nB,export.csv,A.OP,B.PV,,\n"
    )
    (tmp_path / "c.toml").write_text('name = "wide"\ntask = "identify"\nloops = "loops.csv"\n[export]\ntime = "time"\n')
    loop = LoopSettings(name="A", file=str(plant_file(tmp_path / "a.csv", 0)))
    expected = analyse_loop(Work(loop=loop, settings=CampaignSettings(name="a", task="identify"))).points
    rows, _ = analysed(tmp_path / "c.toml", tmp_path / "out")
    assert [row.loop for row in rows] == ["A/raw", "B"]
    for name in ("A%2Fraw", "B"):
        points = read_points(tmp_path / "out" / "loops" / f"{name}.json")
        assert [point.gain for point in points] == pytest.approx([point["gain"] for point in expected], rel=1e-4)
    (prepared,) = (tmp_path / "out" / "tables").iterdir()
    assert pq.read_schema(prepared).names == ["time", "A.OP", "A.PV", "B.PV"]


def test_the_example_reads_a_historian_with_german_numbers_quality_flags_and_a_file_per_day(tmp_path):
    for name in ("boiler_house.toml", "boiler_house.csv"):
        shutil.copy(EXAMPLES / name, tmp_path)
    _, loops = read_campaign(tmp_path / "boiler_house.toml")
    tags: dict[str, list[str]] = {}
    t, _, _ = signals(0)
    for seed, loop in enumerate(loops):
        _, u, y = signals(seed)
        for tag, values in ((loop.u, u), (loop.y, y)):
            tags[tag] = [f"{value:.6f}".replace(".", ",") for value in values]
            tags[f"{tag}.Q"] = ["Good"] * t.size
    tags["TIC101.PV.Q"][300:310] = ["Bad"] * 10
    tags["TIC102.PV"][500:502] = ["I/O Timeout"] * 2
    tags["FIC120.PV.Q"] = ["Bad"] * t.size
    stamps = [f"14.10.2024 00:{int(s // 60):02d}:{int(s % 60):02d},{round(s % 1 * 1000):03d}" for s in t + 1e-9]
    lines = [";".join(cells) for cells in zip(stamps, *tags.values(), strict=True)]
    (tmp_path / "historian").mkdir()
    for day, part in (("14", lines[:1200]), ("15", lines[1200:])):
        text = "\n".join([";".join(["Time", *tags]), *part])
        (tmp_path / "historian" / f"2024-10-{day}.csv").write_text(text + "\n")
    path = tmp_path / "boiler_house.toml"
    path.write_text(path.read_text().replace('"design" ', '"identify" '))
    rows, _ = analysed(path, tmp_path / "out")
    found = {row.loop: row for row in rows}
    assert [row.loop for row in rows if row.attention == "failed"] == ["FIC-120 fuel"]
    assert "no stretch of 60 good rows" in found["FIC-120 fuel"].reason
    assert (found["TIC-101 steam"].rows, found["TIC-101 steam"].bad_rows) == (2000, 10)
    assert "10 rows are flagged as bad" in found["TIC-101 steam"].notes
    assert found["TIC-102 feed water"].bad_rows == 2
    assert found["PIC-110 drum"].rows == 1600
    assert len(list((tmp_path / "out" / "tables").iterdir())) == 2


def test_a_closed_loop_whose_set_point_rests_gives_no_points(tmp_path):
    t, u, y = signals(0)
    path = write(tmp_path / "a.csv", {"t": t, "u": u, "y": y, "r": np.full(t.size, 20.0)})
    work = Work(loop=LoopSettings(name="a", file=str(path)), settings=CampaignSettings(name="a", task="identify"))
    assert "the set-point never moves" in analyse_loop(work).row.reason


def test_a_loop_whose_columns_are_swapped_gives_no_points(tmp_path):
    t, u, y = signals(0)
    path = write(tmp_path / "a.csv", {"t": t, "u": y, "y": u})
    work = Work(loop=LoopSettings(name="a", file=str(path)), settings=CampaignSettings(name="a", task="identify"))
    assert "u and y seem swapped" in analyse_loop(work).row.reason


def test_a_loop_under_control_is_identified_by_subspace(tmp_path):
    rng = np.random.default_rng(0)
    rows, decay = 3000, math.exp(-0.1 / TAU_S)
    r = np.repeat(rng.choice([-1.0, 1.0], rows), 30)[:rows]
    u, y = np.zeros(rows), np.zeros(rows)
    x, integral = 0.0, 0.0
    for k in range(rows):  # PI with K = 1, Ti = 2 s around gain / (tau s + 1)
        y[k] = x + 0.01 * rng.standard_normal()
        integral += 0.1 / 2.0 * (r[k] - y[k])
        u[k] = r[k] - y[k] + integral
        x = decay * x + GAIN * (1.0 - decay) * u[k]
    path = write(tmp_path / "a.csv", {"t": 0.1 * np.arange(rows), "u": u, "y": y, "r": r})
    settings = CampaignSettings(name="a", method="closed-loop", task="identify")
    finding = analyse_loop(Work(loop=LoopSettings(name="a", file=str(path)), settings=settings))
    assert finding.row.attention == "fine", finding.row.reason
    for point in finding.points:
        truth = GAIN / (1.0 + 1j * point["omega_rad_s"] * TAU_S)
        assert point["gain"] == pytest.approx(abs(truth), rel=0.1)


def test_a_loop_whose_present_gains_are_not_known_is_not_called_fine(tmp_path):
    file = str(plant_file(tmp_path / "a.csv", 3))
    bare = analyse_loop(Work(loop=LoopSettings(name="a", file=file, area="mill"), settings=CampaignSettings(name="a")))
    assert (bare.row.attention, bare.row.area, bare.row.reason) == ("designed", "mill", "")
    same = LoopSettings(name="a", file=file, K=bare.row.K, Ti_s=bare.row.Ti_s)
    assert analyse_loop(Work(loop=same, settings=CampaignSettings(name="a"))).row.attention == "fine"


def test_a_defect_in_the_tool_is_a_row_that_says_where(tmp_path, monkeypatch):
    def fails(*_):
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr("autotune.batch.loop.read_record", fails)
    work = Work(loop=LoopSettings(name="a", file="a.csv"), settings=CampaignSettings(name="a"))
    row = analyse_loop(work).row
    assert row.attention == "failed"
    assert "ZeroDivisionError: by nothing (test_campaign.py line" in row.reason


def test_a_diagnosis_says_which_bench_is_not_as_its_model_says(tmp_path):
    shutil.copy(EXAMPLES / "recordings.toml", tmp_path)
    (tmp_path / "recordings").mkdir()
    plant_file(tmp_path / "recordings" / "as believed.csv", 0, rows=600)
    plant_file(tmp_path / "recordings" / "twice.csv", 0, rows=600, gain=2.0 * GAIN)
    (tmp_path / "bench.toml").write_text(
        'name = "plant"\n[input]\noffset = 50.0\n[output]\noffset = 20.0\n[[block]]\nname = "lag"\nplace = "plant"\n'
        f"num = [{GAIN}]\nden = [{TAU_S}, 1.0]\ndelay = {DEAD_TIME_S}\n"
    )
    (twice, believed), _ = analysed(tmp_path / "recordings.toml", tmp_path / "out")
    assert (twice.loop, twice.attention, twice.verdict) == ("twice", "look", "parameters")
    assert twice.retuned < 0.1 * twice.nominal
    assert (believed.attention, believed.verdict) == ("fine", "none")
    diagnosis = json.loads((tmp_path / "out" / "loops" / "twice.json").read_text())["result"]
    assert diagnosis["verdict"] == "parameters"
