from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from autotune.controller import PIDController
from autotune.errors import ExperimentStopped
from autotune.experiment.relay import RelaySettings
from autotune.experiment.result import State, Status
from autotune.live.charts import bode_options, regions_options, strip_options
from autotune.live.controls import Controls
from autotune.live.story import Story
from autotune.points import FrequencyPoint
from autotune.recording import RecordingWriter
from autotune.run_log import RunLog
from tests.autotune.experiment.rigs import ball_config

POINT = FrequencyPoint(omega_rad_s=2.0, response=-3.0 - 4.0j, covariance=((0.01, 0.0), (0.0, 0.04)))
RELAY = RelaySettings(
    y_centre=5.0, midpoint=4.8, amplitude=0.1, hysteresis=0.2, delay_samples=10, smoothing=5, plant_sign=-1
)


def progress(elapsed_s: float, **content: object) -> Status:
    given = {"state": State.SWEEP, "elapsed_s": elapsed_s, "remaining_s": 40.0, "message": "point 2 of 5"} | content
    return Status(**given)  # type: ignore[arg-type]


def test_a_line_counts_once_it_has_ended(tmp_path: Path) -> None:
    with RunLog(tmp_path / "progress.jsonl") as log:
        log.begin(ball_config())
        log.recording(tmp_path / "recording.csv")
    (tmp_path / "recording.csv").write_text("t,u,y\n0,4.8,5\n0.01,4.9,5.1\n0.02,4.9,5.")
    story = Story(tmp_path)
    assert story.poll()
    assert list(story.rows.t) == [0.0, 0.01]
    assert not story.poll()
    with (tmp_path / "recording.csv").open("a") as file:
        file.write("25\n# a remark\n")
    assert story.poll()
    assert list(story.rows.y) == [5.0, 5.1, 5.25]


def test_recordings_of_one_run_lie_one_after_the_other_in_time(tmp_path: Path) -> None:
    with RunLog(tmp_path / "progress.jsonl") as log:
        log.begin(ball_config())
        with RecordingWriter(log.recording(tmp_path / "recording.csv"), ("t", "u", "y")) as first:
            first.append((0.0, 0.0, 9.0))
            first.append((7.0, 0.0, 9.5))
        with RecordingWriter(log.recording(tmp_path / "verification.csv"), ("t", "u", "y", "r")) as second:
            second.append((0.0, 1.0, 5.0, 6.0))
            second.append((2.0, 1.0, 5.0, 6.0))
    story = Story(tmp_path)
    story.poll()
    assert list(story.rows.t) == [0.0, 7.0, 7.0, 9.0]
    assert list(story.rows.r) == [5.0, 5.0, 6.0, 6.0]  # the operating point is the set-point until another is given


def test_the_outcome_says_whose_rig_holds_the_gains(tmp_path: Path) -> None:
    """As the run's own verdict does: of a simulated rig no real one was touched."""
    before, new = PIDController(K=-0.01, Ti_s=6.0), PIDController(K=-0.03, Ti_s=3.5)
    with RunLog(tmp_path / "progress.jsonl") as log:
        log.begin(ball_config())
        log.gains(before, new, deployed=True)
    story = Story(tmp_path)
    story.poll()
    assert story.outcome_text() == "Designed, not tried on the rig. The simulated rig holds the new gains."


def test_the_time_left_runs_down_with_the_rows(tmp_path: Path) -> None:
    with RunLog(tmp_path / "progress.jsonl") as log:
        log.begin(ball_config())
        with RecordingWriter(log.recording(tmp_path / "recording.csv"), ("t", "u", "y")) as writer:
            log.also(None)(progress(10.0, relay=RELAY, points=(POINT,), warnings=("beware",)))
            story = Story(tmp_path)
            writer.append((10.0, 4.9, 5.0))
            story.poll()
            assert story.remaining_s == pytest.approx(40.0)
            writer.append((25.0, 4.7, 5.0))
            story.poll()
            assert story.remaining_s == pytest.approx(25.0)
    assert story.relay_text().startswith("Relay low: 4.8 ± 0.1 V")
    assert story.sign == -1
    assert story.warnings() == ["beware"]
    assert story.points[0].response == pytest.approx(POINT.response)


def test_a_listener_hears_everything_and_the_file_only_what_changed(tmp_path: Path) -> None:
    heard: list[float] = []
    with RunLog(tmp_path / "progress.jsonl") as log:
        tell = log.also(lambda one: heard.append(one.elapsed_s))
        for elapsed_s in range(20):
            tell(progress(float(elapsed_s)))
        tell(progress(20.0, message="point 3 of 5"))
    events = [json.loads(line) for line in (tmp_path / "progress.jsonl").read_text().splitlines()]
    assert [event.get("message") for event in events] == ["point 2 of 5", "point 3 of 5", None]
    assert len(heard) == 21


def test_the_reason_for_the_end_is_told_by_whatever_ends_it(tmp_path: Path) -> None:
    with pytest.raises(ExperimentStopped), RunLog(tmp_path / "progress.jsonl"):
        raise ExperimentStopped("limit reached", remedy="look")
    with pytest.raises(KeyboardInterrupt), RunLog(tmp_path / "progress.jsonl"):
        raise KeyboardInterrupt
    ends = [json.loads(line) for line in (tmp_path / "progress.jsonl").read_text().splitlines()]
    assert [(end["reason"], end["exit_status"]) for end in ends] == [
        ("limit reached; look", 3),
        ("stopped by the operator", 130),
    ]
    story = Story(tmp_path)
    story.poll()
    assert story.ended == "stopped by the operator"


def test_regions_too_small_to_see_are_drawn_larger_and_the_page_is_told(tmp_path: Path) -> None:
    story = Story(tmp_path)
    story.sign = -1
    for covariance, times in ((1e-4, 10.0), (1.0, 1.0)):
        story.points = (
            FrequencyPoint(omega_rad_s=2.0, response=-3 - 4j, covariance=((covariance, 0.0), (0.0, covariance))),
        )
        options, drawn = regions_options(story)
        assert drawn == times
        edge = np.array(options["series"][1]["data"])
        radius = np.hypot(edge[:, 0] - 3.0, edge[:, 1] - 4.0)
        assert radius == pytest.approx(times * story.points[0].region_radii()[0].max(), rel=1e-3)


def test_names_of_states_stand_apart_and_no_region_is_written_over(tmp_path: Path) -> None:
    story = Story(tmp_path)
    for k in range(61):
        for column, value in ((story.rows.t, k), (story.rows.u, 0), (story.rows.y, 5), (story.rows.r, 5)):
            column.append(float(value))
    story.marks = [(0.0, "preflight"), (0.5, "find the mid-point"), (2.0, "relay sweep"), (58.0, "verify")]
    lines = strip_options(story, 60.0)["series"][0]["markLine"]["data"]
    assert [line["label"]["formatter"] for line in lines if line["label"]["show"]] == ["relay sweep"]
    story.points = (POINT,)
    edge = regions_options(story)[0]["series"][1]
    assert edge["endLabel"]["formatter"] == "2"
    assert edge["data"][-1][0] == max(x for x, _ in edge["data"])


def test_charts_can_be_drawn_before_anything_is_known(tmp_path: Path) -> None:
    story = Story(tmp_path)
    story.poll()
    for options in (strip_options(story, 60.0), bode_options(story), regions_options(story)[0]):
        assert all(not series["data"] for series in options["series"])
        json.dumps(options, allow_nan=False)


def test_one_page_holds_the_controls_and_leaves_them_to_whoever_takes_them() -> None:
    asked: list[str] = []
    controls = Controls(asked.append)
    controls.arrive("first")
    controls.arrive("second")
    controls.take("second")
    assert controls.holder == "first"
    controls.present({"first", "second"})
    assert controls.holder == "first"
    controls.present({"second"})
    controls.arrive("third")
    assert controls.holder is None
    controls.take("second")
    assert controls.holder == "second"


def test_no_line_can_name_a_file_outside_the_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (tmp_path / "secret.csv").write_text("t,u,y\n0,1,2\n")
    (run / "recording.csv").symlink_to(tmp_path / "secret.csv")
    names = ["../secret.csv", str(tmp_path / "secret.csv"), "recording.csv", "progress.jsonl", "", "a/../recording.csv"]
    lines = [json.dumps({"event": "recording", "file": name}) for name in names]
    (run / "progress.jsonl").write_text("\n".join(lines) + "\n")
    story = Story(run)
    story.poll()
    assert list(story.rows.t) == []
    assert story.unread == len(names)
    assert "damaged" in story.warnings()[0]


BROKEN = [
    "", "nonsense", "{}", "[]", "5", "null", '{"event": "unknown"}', '{"event": "run"}',
    '{"event": "run", "config": 5}',
    '{"event": "progress", "state": 5}', '{"event": "gains", "old": {}, "new": {"K": "x"}}', "[" * 100_000,
    '{"event": "verification", "accepted": true, "reason": "x", "steps": {"t": [1]}}',
    '{"event": "analysis", "points": 5, "plant": null}', '{"event": "waiting", "patience_s": -1}',
    '{"event": "ended", "reason": "\\u001b[2J"}', '{"event": "waiting", "patience_s": NaN}',
]  # fmt: skip


@pytest.mark.parametrize("line", BROKEN)
def test_a_damaged_line_is_counted_and_the_rest_is_shown(tmp_path: Path, line: str) -> None:
    with RunLog(tmp_path / "progress.jsonl") as log:
        log.begin(ball_config())
        with (tmp_path / "progress.jsonl").open("a") as file:
            file.write(line + "\n")
        log.waiting(30.0)
    story = Story(tmp_path)
    story.poll()
    assert story.config is not None
    assert story.ended == "completed"
    assert story.unread == 1


def test_a_damaged_row_is_left_out(tmp_path: Path) -> None:
    with RunLog(tmp_path / "progress.jsonl") as log:
        log.begin(ball_config())
        log.recording(tmp_path / "recording.csv")
    (tmp_path / "recording.csv").write_text("t,u,y\n0,1,2\nx,y,z\n1,2\n-5,1,1\n1e300,1,1\n2,1,2\n")
    story = Story(tmp_path)
    story.poll()
    assert list(story.rows.t) == [0.0, 2.0]
    assert story.unread == 4
