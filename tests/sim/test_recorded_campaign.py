"""A campaign on recorded rigs: what is new counts, cases of one rig belong together, answers are sealed."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from sim.proof import diagnose, seal
from sim.recorded.campaign import RecordedMark, as_json, conceal, mark_all, open_campaign, raises_alarm
from sim.recorded.cases import STRENGTHS, make, prepare
from sim.recorded.rigs import RefusedError, read
from sim.recorded.score import by_rig, cluster_interval, table
from sim.score import mark, wilson
from tests.sim.recorded_rig import record, write_recording, write_rig

REAL = Path(__file__).parents[2].parent / "shared" / "real_cases"
#: Always names a lag, and whatever the folder of the case has in ``says``; forecasts are the readings themselves.
TOOL = """
import json, pathlib, sys
words = sys.argv[1:]
out = pathlib.Path(words[words.index("--out") + 1])
if words[0] == "diagnose":
    case = pathlib.Path(words[words.index("--model") + 1]).parent
    more = (case / "says").read_text().split() if (case / "says").exists() else []
    effects = [{"name": n, "probability": 0.9, "places": [n.split(".")[0]]} for n in ["actuator.lag", *more]]
    verdict = "unexplained" if "sensor.quantisation" in more else "effect"
    (out / "diagnosis.json").write_text(json.dumps({"verdict": verdict, "effects": effects, "places": ["actuator"]}))
    (out / "extended_model.toml").write_text("")
else:
    rows = pathlib.Path(words[3]).read_text().splitlines()[1:]
    out.write_text("t,y_sim\\n" + "\\n".join(",".join(row.split(",")[i] for i in (0, 2)) for row in rows))
"""


@pytest.fixture
def rigs(tmp_path):
    for name in ("a", "b"):
        write_rig(tmp_path / "rigs" / name, rows=600)
    (tmp_path / "tool.py").write_text(TOOL)
    return tmp_path / "rigs"


def begun(rigs, out, count=6):
    campaign = open_campaign(rigs, out, count, 100_000, (sys.executable, str(rigs.parent / "tool.py")))
    list(conceal(campaign))
    return campaign


def answered(campaign, seed):
    return json.loads(campaign.cases.answer(seed).read_text())


def test_only_what_is_new_against_the_recording_as_it_is_counts(rigs, tmp_path):
    campaign = begun(rigs, tmp_path / "out")
    right = {seed: answered(campaign, seed) for seed in campaign.cases.seeds}
    for seed, answer in right.items():
        says = [answer["effects"][0]["name"]] if answer["kind"] == "single" else []
        (campaign.cases.case(seed) / "says").write_text(" ".join(says))
        diagnose(campaign.cases, seed)
    for i in campaign.as_recorded.seeds:
        diagnose(campaign.as_recorded, i)
    for m, answer in zip(mark_all(campaign), right.values(), strict=True):
        assert m.before == ("actuator.lag",)
        assert "actuator.lag" not in m.mark.named
        lag = answer["kind"] == "single" and "actuator.lag" in answer["effects"][0]["accept"]
        assert bool(m.not_counted) is lag
        if answer["kind"] == "clean":
            assert m.mark.verdict_right  # the lag was said before
        elif not lag:
            assert m.mark.first_right
        if answer["improvable"]:  # the program cheats: its forecast is the reading
            assert m.mark.gap == pytest.approx(1.0, abs=1e-6) or m.mark.gap > 1.0
    rows = {row.figure: row for row in table(mark_all(campaign))}
    assert rows["numbers changed only: something new said"].value in (0.0, pytest.approx(np.nan, nan_ok=True))
    assert json.loads(json.dumps(as_json(campaign, mark_all(campaign))))["as_recorded"][0]["named"] == {
        "actuator.lag": 0.9
    }


@pytest.mark.parametrize(("put_in", "is_right"), [("numbers: offset", True), ("numbers: gain", False)])
def test_an_operating_point_that_was_moved_may_be_called_so(rigs, tmp_path, put_in, is_right):
    campaign = begun(rigs, tmp_path / "out", count=2)
    seed = campaign.cases.seeds[0]
    answer = {**answered(campaign, seed), "kind": "clean", "sub": put_in, "verdict": "parameters", "effects": []}
    campaign.cases.answer(seed).write_text(json.dumps({**answer, "places": [], "improvable": False}))
    (campaign.cases.case(seed) / "says").write_text("actuator.offset")
    diagnose(campaign.cases, seed)
    for i in campaign.as_recorded.seeds:
        diagnose(campaign.as_recorded, i)
    marked = mark_all(campaign)[0]
    assert marked.before == ("actuator.lag",)
    assert marked.mark.verdict_right is is_right
    assert marked.mark.named == (() if is_right else ("actuator.offset",))


def test_a_campaign_goes_on_with_the_same_answers_and_not_with_other_recordings(rigs, tmp_path):
    first = seal(begun(rigs, tmp_path / "out").cases)
    assert seal(begun(rigs, tmp_path / "out").cases) == first
    assert seal(begun(rigs, tmp_path / "again").cases) == first
    write_recording(rigs / "a" / "fit.csv", *record(9, 600))
    with pytest.raises(RefusedError, match="other recordings"):
        begun(rigs, tmp_path / "out")


def test_a_case_has_what_a_user_would_have_and_the_recording_kept_back(rigs, tmp_path):
    campaign = begun(rigs, tmp_path / "out", 2)
    for seed in campaign.cases.seeds:
        assert {path.name for path in campaign.cases.case(seed).iterdir()} == {"model.toml", "rec1.csv", "unseen.csv"}
    plain = np.loadtxt(campaign.as_recorded.case(0) / "rec1.csv", delimiter=",", skiprows=1)
    assert np.array_equal(plain, np.loadtxt(rigs / "a" / "fit.csv", delimiter=",", skiprows=1))


def test_a_name_that_was_not_said_before_is_an_alarm():
    def said(verdict, *names):
        return {"verdict": verdict, "effects": [{"name": name} for name in names]}

    assert raises_alarm(said("unexplained", "sensor.quantisation"), said("unexplained"))

    assert raises_alarm(said("effect", "plant.leak", "sensor.lag"), said("effect", "plant.leak"))
    assert raises_alarm(said("unexplained"), said("none"))
    assert raises_alarm(said("failed"), said("unexplained"))
    assert not raises_alarm(said("unexplained"), said("effect", "plant.leak"))
    assert not raises_alarm(said("effect", "plant.leak"), said("effect", "plant.leak", "sensor.lag"))
    assert not raises_alarm(said("none"), said("unexplained"))


def test_an_interval_over_rigs_that_differ_is_wider_and_where_all_agree_each_rig_counts_once():
    alike = [(f"rig {i}", i % 2 == 0) for i in range(40)]
    assert cluster_interval(alike) == pytest.approx(wilson(20, 40), abs=0.01)
    differ = [(f"rig {i // 10}", i // 10 % 2 == 0) for i in range(40)]
    assert cluster_interval(differ)[1] - cluster_interval(differ)[0] > 1.8 * (wilson(20, 40)[1] - wilson(20, 40)[0])
    assert cluster_interval([(f"rig {i // 4}", True) for i in range(40)]) == wilson(10, 10)
    assert cluster_interval([]) == (0.0, 1.0)


def test_the_interval_over_rigs_covers_the_share_of_rigs_that_differ():
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(1000):
        shares = np.repeat(rng.beta(6.0, 2.0, 25), 4)  # correlation within a rig 1/9
        low, high = cluster_interval([(str(i // 4), bool(rng.random() < p)) for i, p in enumerate(shares)])
        inside.append(low <= 0.75 <= high)
    assert 0.92 < np.mean(inside) < 0.98


def test_the_lines_of_a_rig_say_what_was_missed():
    answer = {
        "kind": "single", "strength": "weak", "rig": "a", "verdict": "effect", "places": ["sensor"], "nuisance": [],
        "effects": [{"name": "sensor.drift", "accept": ["sensor.drift"]}], "improvable": False,
    }  # fmt: skip
    said = {
        "verdict": "effect",
        "places": [],
        "effects": [{"name": "plant.leak", "probability": 0.8, "places": ["plant"]}],
    }
    m = RecordedMark(mark=mark("c", answer, said, None), before=(), not_counted="")
    assert by_rig([m]) == [("a", 1, 0, 1, ["sensor.drift (weak): plant.leak 0.80"])]


@pytest.mark.skipif(not REAL.is_dir(), reason="no recordings of real rigs beside the checkout")
def test_on_real_rigs_a_case_has_its_strength():
    short = [prepare(read(REAL / name, name)) for name in ("hair_dryer_null", "p_12")]
    for seed in range(100_000, 100_006):
        made = make(seed, short)
        if made.strength is not None:
            low, high = STRENGTHS[made.strength]
            assert low <= made.ratio <= high
