"""Campaigns that look at loops in operation: what rows and the page say, what is refused, what is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from autotune.batch.operation import look_in_operation
from autotune.batch.settings import RoutineSettings, read_campaign
from autotune.cli import app
from autotune.errors import InputError
from autotune.recording import Recording
from tests.autotune.batch.plant_files import write
from tests.sim.valve_cases import CaseKind, valve_case

EXAMPLE = Path(__file__).resolve().parents[3] / "configs" / "campaigns" / "in_operation.toml"
SEEDS: dict[CaseKind, int] = {"stiction": 5000, "tight_steps": 5000, "outside": 5000, "quiet": 5000}


def columns_of(kind: CaseKind) -> dict[str, np.ndarray]:
    case = valve_case(kind, SEEDS[kind])
    return {"t": case.dt_s * np.arange(case.u.size), "u": case.u, "y": case.y, "r": case.r}


@pytest.fixture(scope="module")
def looked_at(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of a campaign over four loops of known cause, one at rest and one damaged; what the command said."""
    folder = tmp_path_factory.mktemp("mill")
    (folder / "operation").mkdir()
    for kind in SEEDS:
        write(folder / "operation" / f"{kind}.csv", columns_of(kind))
    still = columns_of("quiet")
    write(folder / "operation" / "still.csv", still | {"u": 0.0 * still["u"]})
    (folder / "operation" / "broken.csv").write_text("t,u,y\n0,1,2\n1,1,x\n")
    (folder / "campaign.toml").write_text(EXAMPLE.read_text())
    command = ["batch", str(folder / "campaign.toml"), "--out", str(folder / "out"), "--workers", "1"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    return folder / "out", done.output


def test_the_worst_loops_come_first_with_what_was_found_and_how_sure(looked_at: tuple[Path, str]) -> None:
    rows = pq.read_table(looked_at[0] / "results.parquet").to_pylist()
    by_loop = {row["loop"]: row for row in rows}
    assert {row["loop"] for row in rows[:2]} == {"stiction", "tight_steps"}
    assert by_loop["quiet"]["attention"] == "fine"
    assert {name: by_loop[name]["verdict"] for name in SEEDS} == {
        "stiction": "stiction", "tight_steps": "tight_tuning", "outside": "outside_oscillation", "quiet": "none"
    }  # fmt: skip
    valve = by_loop["stiction"]
    assert valve["band_low"] < valve_case("stiction", SEEDS["stiction"]).loop.S < valve["band_high"]
    assert valve["chance"] <= 0.005
    assert f"{valve['reversals']} reversals, by chance" in valve["sure"]
    assert valve["what_next"].startswith("Put the loop in manual")
    assert by_loop["outside"]["band"] is None
    assert by_loop["outside"]["severity"] > 0.3


def test_loops_that_show_nothing_are_a_line_each(looked_at: tuple[Path, str]) -> None:
    rows = {row["loop"]: row for row in pq.read_table(looked_at[0] / "results.parquet").to_pylist()}
    assert rows["still"]["attention"] == rows["broken"]["attention"] == "failed"
    assert "u is constant (0)" in rows["still"]["reason"]
    assert "broken.csv" in rows["broken"]["reason"]
    assert "failed  still: " in looked_at[1]


def test_the_page_ranks_and_says_what_to_do(looked_at: tuple[Path, str]) -> None:
    page = (looked_at[0] / "report.html").read_text()
    assert page.index("Needs action") < page.index("Deserves a look") < page.index("Fine (1)")
    for said in ("Stiction in the valve", "how sure", "Put the loop in manual", "An oscillation from outside"):
        assert said in page


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('task = "design"\n[routine]\n', r'\[routine\] goes with task = "routine", and task is "design"'),
        ('task = "routine"\n[routine]\nchance = 0.5\n', r"routine\.chance"),
        ('task = "routine"\n[routine]\nleast_reversals = true\n', r"routine\.least_reversals"),
        ('task = "routine"\n[routine]\nleast_reversal = 9\n', "did you mean 'least_reversals'"),
    ],
)
def test_a_table_of_the_routine_that_cannot_be_meant_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "a.csv").write_text("t,u,y\n")
    (tmp_path / "c.toml").write_text(f'name = "c"\nfolder = "*.csv"\n{text}')
    with pytest.raises(InputError, match=said):
        read_campaign(tmp_path / "c.toml")


def test_pieces_that_cannot_be_looked_at_are_left_out_with_a_note() -> None:
    case = columns_of("stiction")
    whole = Recording(t=case["t"], u=case["u"], y=case["y"], name="whole")
    short = Recording(t=case["t"][:50], u=case["u"][:50], y=case["y"][:50], name="short")
    slower = Recording(t=2.0 * case["t"][:500], u=case["u"][:500], y=case["y"][:500], name="slower")
    found, notes = look_in_operation([short, whole, slower], None)
    assert found.faulty
    assert notes == ("2 of 3 pieces are left out, the first: short: 50 rows; a routine record needs at least 100 rows,"
                     " best ten periods of an oscillation",)  # fmt: skip
    with pytest.raises(InputError, match="short: 50 rows"):
        look_in_operation([short], None)


def test_more_reversals_than_a_record_holds_name_no_valve() -> None:
    case = columns_of("stiction")
    whole = Recording(t=case["t"], u=case["u"], y=case["y"], name="whole")
    assert not look_in_operation([whole], RoutineSettings(least_reversals=9999))[0].faulty
