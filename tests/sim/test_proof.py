"""A campaign end to end, with a small program in the tool's place that always says the same."""

import json
import sys
from dataclasses import replace

import pytest

from sim.proof import Campaign, conceal, diagnose, keep_failures, mark_all, seal, singles

ALWAYS_NONE = """
import json, pathlib, sys
words = sys.argv[1:]
out = pathlib.Path(words[words.index("--out") + 1])
if words[0] == "diagnose":
    (out / "diagnosis.json").write_text(json.dumps({"verdict": "none", "effects": [], "places": []}))
    (out / "extended_model.toml").write_text("")
else:
    rows = pathlib.Path(words[3]).read_text().splitlines()[1:]
    out.write_text("t,y_sim\\n" + "\\n".join(",".join(row.split(",")[i] for i in (0, 2)) for row in rows))
"""


@pytest.fixture
def campaign(tmp_path):
    tool = tmp_path / "tool.py"
    tool.write_text(ALWAYS_NONE)
    return Campaign(out=tmp_path / "proof", seeds=range(66, 69), tool=(sys.executable, str(tool)))


def test_a_campaign_is_sealed_diagnosed_and_marked_and_goes_on_where_it_was_stopped(campaign):
    assert list(conceal(campaign)) == [66, 67, 68]
    before = seal(campaign)
    diagnose(campaign, 66)
    first = (campaign.diagnosis(66) / "finished").stat().st_mtime_ns
    for seed in campaign.seeds:
        diagnose(campaign, seed)
    assert (campaign.diagnosis(66) / "finished").stat().st_mtime_ns == first
    assert seal(campaign) == before
    marks = mark_all(campaign, list(campaign.seeds))
    for m in marks:
        answer = json.loads((campaign.out / "sealed" / f"{m.case}.json").read_text())
        assert m.verdict_right == (answer["verdict"] == "none")
        if answer["improvable"]:  # this program cheats: its forecast is the measurement itself
            assert m.gap > 1.0
    ablated = replace(campaign, without="plant.leak")  # what it says is kept apart
    assert ablated.finished == []
    diagnose(ablated, 67)
    assert ablated.finished == [67]
    assert campaign.finished == [66, 67, 68]
    for name, seeds in singles(campaign).items():
        assert all(name in campaign.answer(seed).read_text() for seed in seeds)
    text = keep_failures(campaign, marks).read_text()
    assert text.count("case_") == sum(m.failed for m in marks) > 0


def test_the_seal_breaks_when_an_answer_changes(campaign):
    campaign = replace(campaign, seeds=range(67, 68))
    list(conceal(campaign))
    before = seal(campaign)
    answer = campaign.answer(67)
    answer.write_text(answer.read_text().replace("rig", "rlg", 1))
    assert seal(campaign) != before


def test_a_tool_that_fails_on_a_case_has_said_nothing(campaign, tmp_path):
    (tmp_path / "tool.py").write_text("import sys; sys.exit('no')")
    campaign = replace(campaign, seeds=range(67, 68))
    list(conceal(campaign))
    diagnose(campaign, 67)
    (m,) = mark_all(campaign, [67])
    assert m.verdict == "failed"
    assert m.failed
    assert "no" in (campaign.diagnosis(67) / "stderr.txt").read_text()


def test_a_case_that_the_operator_stopped_is_diagnosed_again(campaign, tmp_path):
    campaign = replace(campaign, seeds=range(67, 68))
    list(conceal(campaign))
    tool = (tmp_path / "tool.py").read_text()
    stopped = "if words[0] == 'simulate':\n    import os, signal; os.kill(os.getpid(), signal.SIGINT)"
    (tmp_path / "tool.py").write_text(tool + stopped)
    with pytest.raises(InterruptedError):
        diagnose(campaign, 67)
    # as the diagnosis does, the tool refuses to overwrite
    (tmp_path / "tool.py").write_text(tool.replace("write_text(json", 'open("x").write(json'))
    diagnose(campaign, 67)
    assert (campaign.diagnosis(67) / "finished").read_text() == "0\n"
