"""The fault campaign's short form: each fault once; ``make bench`` strikes at many moments."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest

from tests.drivers.campaign import FAULTS, Fault, run_fault
from tests.drivers.ctrl_c import STATES, stop_in
from tests.drivers.foreign_line import faults_on_controller
from tests.drivers.plant_campaign import PLANT_FAULTS, PlantFault, run_plant_fault
from tests.drivers.signals import SIGNALS, strike_process
from tests.drivers.test_own_controller import compiled_controller


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_rig_is_safe_and_no_bad_sample_is_kept(fault: Fault) -> None:
    outcome = run_fault(fault, seed=5)
    assert outcome.is_good, outcome
    assert outcome.rows >= 5
    assert any(re.search(end, outcome.ended) for end in fault.ends), outcome.ended
    assert outcome.exit_status == (0 if outcome.ended == "completed" else 3)
    assert "\n" not in outcome.ended


#: those that need a process of the rig's own; the others are tests of their own
OF_PROCESSES = tuple(fault for fault in PLANT_FAULTS if re.search("for good|process|second master", fault.name))


@pytest.mark.parametrize("fault", OF_PROCESSES, ids=lambda fault: fault.name)
def test_what_plants_do_leaves_the_rig_safe_and_is_said_in_one_line(fault: PlantFault) -> None:
    outcome = run_plant_fault(fault, seed=5)
    assert outcome.is_good, outcome
    assert any(re.search(end, outcome.ended) for end in fault.ends), outcome.ended
    assert outcome.exit_status == (0 if outcome.ended == "completed" else 3)
    assert "\n" not in outcome.ended


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled_controller(tmp_path_factory.mktemp("controller"))


@pytest.mark.system("libmodbus-dev", "gcc")
@pytest.mark.parametrize("name", ["half-open", "second master, once", "second master, 5 a second", "no dead-man"])
def test_a_controller_in_c_is_safe_and_the_cause_is_named(program: Path, tmp_path: Path, name: str) -> None:
    (fault,) = (one for one in faults_on_controller(program, tmp_path) if name in one.name)
    outcome = run_fault(fault, seed=5)
    assert outcome.is_good, outcome
    assert any(re.search(end, outcome.ended) for end in fault.ends), outcome.ended


@pytest.mark.parametrize(("number", "status", "line"), SIGNALS, ids=lambda value: getattr(value, "name", None))
def test_a_stopped_killed_or_starved_process_leaves_the_rig_safe_and_the_recording_readable(
    number: signal.Signals | None, status: int, line: str
) -> None:
    outcome = strike_process(number, seed=2)
    assert outcome.is_good, outcome
    assert outcome.exit_status == status
    assert line in outcome.ended
    assert "\n" not in outcome.ended
    assert outcome.rows >= 5


@pytest.mark.parametrize("state", STATES)
def test_the_operator_can_stop_it_in_every_state(state: str) -> None:
    outcome = stop_in(state, seed=4)
    assert outcome.is_good, outcome
    assert "stopped by Ctrl-C" in outcome.ended
    assert outcome.exit_status == 130
