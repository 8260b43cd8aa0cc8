"""A relay in the PLC with OPC UA as its operator: the shipped block, compiled and scanned, behind a server."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from autotune.config import load_config
from autotune.config.rig import OpcUaSettings
from autotune.errors import ExperimentStopped, InputError, LinkError, NotTaken
from autotune.experiment.relay import RelaySettings
from autotune.experiment.rig import Row, RunsRelay
from autotune.identification.frequency.limit_cycle_points import limit_cycle_points
from drivers import open_rig
from drivers.opcua_rig import probe_kind
from drivers.operated_relay import OperatedRelayRig
from tests.drivers.iec_compiler import Blocks
from tests.drivers.operated_plc import DEADMAN_S, U_RANGE, U_SAFE, OperatedPlc, Program, settings_of
from tests.drivers.scanned_plc import Lags
from tests.drivers.test_rig_commands import free_port

pytestmark = pytest.mark.system("gcc")
CYCLE_S, ROW_S, LAGS_S = 0.005, 0.01, (0.2, 0.05)
RELAY = RelaySettings(y_centre=5.0, midpoint=5.0, amplitude=2.0, hysteresis=0.05, delay_samples=6.5)
LIMITS = (1.0, 9.0)


class Bench:
    """The PLC with a quiet plant, and the rig on it."""

    def __init__(self, blocks: Blocks) -> None:
        self.program = Program(Lags(LAGS_S, noise=0.0), blocks, CYCLE_S)
        self.endpoint = f"opc.tcp://127.0.0.1:{free_port()}"
        self.served = OperatedPlc(self.program, self.endpoint)
        rig = open_rig(settings_of(self.endpoint, CYCLE_S), u_range=U_RANGE, u_safe=U_SAFE)
        assert isinstance(rig, OperatedRelayRig)
        assert isinstance(rig, RunsRelay)
        self.rig = rig

    def wait(self, seconds: float) -> None:
        self.rig.clock.sleep_until(self.rig.clock.now() + seconds)

    def rows(self, count: int) -> list[Row]:
        return [self.rig.row() for _ in range(count)]

    def begin(self, **changes: Any) -> None:
        """Bring the plant to its operating point and start the relay there."""
        self.rig.open()
        for _ in range(30):
            self.rig.write(5.0)
            self.wait(0.05)
        given = {"row_s": ROW_S, "time_s": 60.0, "y_range": LIMITS} | changes
        self.rig.start_relay(RELAY, **given)


@pytest.fixture
def bench(rig_blocks: Blocks) -> Iterator[Bench]:
    made = Bench(rig_blocks)
    with made.served:
        yield made
        made.rig.close()


def test_a_limit_cycle_is_the_plants_response_however_late_the_host_reads_its_rows(bench: Bench) -> None:
    bench.begin()
    rows = bench.rows(300)
    bench.wait(0.2)  # as long as twenty rows
    rows += bench.rows(300)
    t = np.array([row.reading.t_s for row in rows])
    assert np.diff(t) == pytest.approx(ROW_S, abs=1e-9)
    y = np.array([row.reading.y for row in rows])
    u = np.array([row.u_mean for row in rows[1:]] + [rows[-1].reading.u_applied])  # held from the row on
    point = limit_cycle_points(t[100:], u[100:], y[100:]).points[0]
    s = 1j * point.omega_rad_s
    exact = 1.0 / ((LAGS_S[0] * s + 1.0) * (LAGS_S[1] * s + 1.0))
    assert abs(point.response / exact) == pytest.approx(1.0, abs=0.01)
    assert abs(np.angle(point.response / exact)) / point.omega_rad_s < 1e-3


def test_what_the_plant_got_is_what_the_rows_add_up_to_also_over_rows_that_were_lost(bench: Bench) -> None:
    bench.begin()
    row = bench.rig.row()
    for _ in range(4):  # longer than the ring is, the dead-man fed
        bench.wait(0.2)
        bench.rig.feed()
    before = row.reading
    while (row := bench.rig.row()).reading.t_s - before.t_s < 1.5 * ROW_S:
        before = row.reading  # what had come before
    cycles = round((row.reading.t_s - before.t_s) / CYCLE_S)
    assert cycles > 2 * 10
    outputs, measured = np.array(bench.program.outputs), np.array(bench.program.measured)
    at = int(np.flatnonzero(measured == row.reading.y)[0])
    assert row.u_mean == pytest.approx(np.mean(outputs[at - cycles : at]), abs=1e-9)


def test_the_hosts_next_command_takes_the_actuator_back_without_a_bump(bench: Bench) -> None:
    bench.begin()
    bench.rows(50)
    bench.rig.write(4.0)
    assert bench.rig.read().u_applied == 4.0
    bench.rig.start_relay(RELAY, row_s=ROW_S, time_s=60.0, y_range=LIMITS)
    bench.rig.row()
    outputs = set(np.round(bench.program.outputs[-400:], 6))
    assert U_SAFE not in outputs
    bench.rig.make_safe()
    assert bench.program.output == U_SAFE
    bench.rig.open()  # by ENABLE alone no relay starts
    bench.wait(0.1)
    assert bench.program.block.value["MODE"] == 1
    bench.rig.make_safe()


def test_another_setting_changes_the_relay_that_runs(bench: Bench) -> None:
    bench.begin()
    rows = bench.rows(100)
    wider = replace(RELAY, amplitude=3.0)
    bench.rig.start_relay(wider, row_s=ROW_S, time_s=60.0, y_range=LIMITS)
    rows += bench.rows(200)
    assert np.diff([row.reading.t_s for row in rows]) == pytest.approx(ROW_S, abs=1e-9)
    assert {round(row.reading.u_applied, 3) for row in rows[-100:]} >= {2.0, 8.0}


def test_a_host_that_falls_silent_leaves_the_relay_at_the_safe_output(bench: Bench) -> None:
    bench.begin()
    bench.rig.row()
    bench.wait(DEADMAN_S + 0.2)
    assert bench.program.output == U_SAFE
    with pytest.raises(LinkError, match="took the actuator back"):
        bench.rows(400)


def test_y_beyond_its_limits_ends_it_at_the_safe_output_with_the_value(bench: Bench) -> None:
    bench.begin(y_range=(4.9, 5.1))
    with pytest.raises(ExperimentStopped, match=r"limit reached: the device ended its relay at y = [45]\.\d+"):
        bench.rows(400)
    assert bench.program.output == U_SAFE


def test_its_time_ends_it(bench: Bench) -> None:
    bench.begin(time_s=0.5)
    with pytest.raises(ExperimentStopped, match="time over"):
        bench.rows(400)
    assert bench.program.output == U_SAFE


def test_rows_between_cycles_and_arrays_that_are_none_are_refused_before_the_relay_starts(bench: Bench) -> None:
    with pytest.raises(InputError, match=r"no multiple of the device's cycle of 0\.005 s"):
        bench.begin(row_s=0.012)
    bench.rig.make_safe()
    bench.rig.close()
    known = {"law": "ns=2;s=law", "rows": "ns=2;s=rows"}
    for changes, said in (
        ({"rows": "ns=2;s=law"}, "ns=2;s=law has 14 numbers, not 260; map rig.relay.rows to ROWS of OPERATED_RIG"),
        ({"rows": "ns=2;s=heartbeat"}, "holds another type"),
        ({"law": "ns=2;s=nothing"}, "does not exist"),
        ({"law": "ns=2;s=rows"}, "ns=2;s=rows has 260 numbers, not 14"),
    ):
        settings = settings_of(bench.endpoint, CYCLE_S, relay=known | changes)
        rig = open_rig(settings, u_range=U_RANGE, u_safe=U_SAFE)
        beats = bench.program.held["HEARTBEAT"]
        with pytest.raises(NotTaken, match=said):
            rig.open()
        rig.close()
        assert bench.program.held["HEARTBEAT"] == beats
    found = probe_kind(settings_of(bench.endpoint, CYCLE_S), {})
    assert re.search(r"; a relay in the device, law \d+ taken, mode 0$", found.description)


def test_a_relay_in_the_device_needs_what_ends_it() -> None:
    table = settings_of("opc.tcp://127.0.0.1:1", CYCLE_S).model_dump(exclude_none=True)
    for lacking in ("heartbeat", "enable", "in_command"):
        nodes = {
            name: node for name, node in table["nodes"].items() if name not in (lacking, "heartbeat_echo", "trial")
        }
        with pytest.raises(ValueError, match=f"a relay in the device needs the nodes of {lacking}"):
            OpcUaSettings.model_validate(table | {"nodes": nodes})
    with pytest.raises(ValueError, match="needs scan_time_s"):
        OpcUaSettings.model_validate(table | {"scan_time_s": None})


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_with_the_relay_in_the_plc_is_accepted_and_kept(tmp_path: Path, rig_blocks: Blocks) -> None:
    from autotune.pipeline import tune

    endpoint = f"opc.tcp://127.0.0.1:{free_port()}"
    lags_s = (0.5, 0.15)
    plant = Lags(lags_s)
    plant.advance(U_SAFE, 20.0)  # at rest there, however soon the host comes
    program = Program(plant, rig_blocks, CYCLE_S, deadman_s=2.0)
    content: dict[str, Any] = {
        "name": "plc",
        "rig": settings_of(endpoint, CYCLE_S).model_dump(mode="json", exclude_none=True),
        "signals": {"sample_time_s": 0.02, "u_unit": "V", "y_unit": "V"},
        "limits": {"u_min": 0.0, "u_max": 10.0, "u_safe": U_SAFE, "y_min": 0.5, "y_max": 9.5, "swing": 3.0,
                   "time_s": 200.0, "late_s": 1.0},
        "operating_point": {"y": 5.0, "u_guess": 5.0, "u_uncertainty": 0.5, "approach": "ramp"},
        "experiment": {"budget_s": 60.0, "points": 3, "gain_sd": 0.02},
        "design": {"noise_gain": 20.0},
    }  # fmt: skip
    (tmp_path / "plc.toml").write_text(tomli_w.dumps(content))
    config = load_config(tmp_path / "plc.toml")
    with OperatedPlc(program, endpoint):
        rig = open_rig(config.rig, u_range=U_RANGE, u_safe=U_SAFE)
        tuning = tune(rig, config, tmp_path)
        assert tuning.verification is not None
        assert tuning.verification.accepted, tuning.verification.reason
        assert (tuning.verification.by, tuning.deployed) == ("device", True)
        for point in tuning.experiment.points:
            s = 1j * point.omega_rad_s
            exact = 1.0 / ((lags_s[0] * s + 1.0) * (lags_s[1] * s + 1.0))
            assert abs(point.response / exact) == pytest.approx(1.0, abs=0.05)
        assert program.output == U_SAFE
        rig.close()
