"""What plants do to a session: resets, scans, few sockets, second masters, a host that was killed, interlocks."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from autotune.errors import ExperimentStopped, LinkError, NotTaken, OperatorStop
from autotune.experiment.limits import Envelope
from autotune.experiment.loop import ControlLoop, Tick
from autotune.experiment.rig import HandsBack
from autotune.experiment.run import further_columns
from autotune.recording import RecordingWriter, read_recording
from drivers.register_rig import RegisterRig
from drivers.session_lock import SessionLock
from tests.drivers.bench import LIMIT_S, rig_of, tcp_settings
from tests.drivers.lines import LIMITS
from tests.drivers.scanning_plc import DOOR, REGISTERS, ScanningPlc, plc_settings

GO = "Go to the rig: its safe output was not confirmed"


def rig_on(plc: ScanningPlc, **changes: Any) -> RegisterRig:
    rig = rig_of(plc_settings(plc.port, **changes))
    assert isinstance(rig, RegisterRig)
    return rig


def session(rig: Any, path: Path, law: Callable[[Tick], float], sample_time_s: float = 0.02) -> ControlLoop:
    """Run a law until something ends it, or half a second has passed."""
    # a busy computer is not what is tested
    envelope = Envelope(settings=LIMITS.model_copy(update={"late_s": 5.0}), sample_time_s=sample_time_s)
    writer = RecordingWriter(path, ("t", "u", "y", "u_applied"), {})
    with ControlLoop(rig=rig, envelope=envelope, writer=writer, extra=("u_applied",)) as loop:
        while loop.tick.t_s < 0.5:
            loop.step(loop.nearest(law(loop.tick)))
    return loop


def ended(path: Path) -> dict[str, Any]:
    return dict(read_recording(path).metadata["ended"])


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return tmp_path / "recording.csv"


# -- resets --


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("which", ["a command", "a sample"])
def test_a_reset_once_is_ridden_through(recording: Path, moment: str, which: str) -> None:
    function, left = (16 if which == "a command" else 4), [1]

    def reset_at(request: bytes) -> str:
        if request[1] == function and plc.commands and left:
            left.pop()
            return moment
        return ""

    with ScanningPlc() as plc:
        plc.reset_at = reset_at
        session(rig_on(plc), recording, lambda tick: 0.2)
        assert not left
        plc.settle()
        assert plc.u == pytest.approx(LIMITS.u_safe)
    assert ended(recording)["reason"] == "completed"


@pytest.mark.parametrize("moment", ["before", "after"])
def test_resets_without_end_are_a_link_error_and_the_line_says_go_to_the_rig(recording: Path, moment: str) -> None:
    with ScanningPlc() as plc:

        def law(tick: Tick) -> float:
            if tick.k == 5:
                plc.reset_at = lambda request: moment
            return 0.2

        with pytest.raises(LinkError, match=rf"connection was lost .*\. {GO}") as stop:
            session(rig_on(plc), recording, law)
        assert stop.value.exit_status == 3
    assert "not confirmed" in ended(recording)["output"]
    assert GO in ended(recording)["reason"]


@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_reset_at_make_safe_is_ridden_through_or_said(recording: Path, moment: str) -> None:
    with ScanningPlc() as plc:
        rig, left = rig_on(plc), [1]
        leave = rig.make_safe

        def leave_under_resets() -> None:
            plc.reset_at = lambda request: moment if left and not left.clear() else ""
            leave()

        rig.make_safe = leave_under_resets  # type: ignore[method-assign]  # the real one, with a reset on its way
        session(rig, recording, lambda tick: 0.2)
        assert ended(recording)["output"] == "safe output"
        plc.settle()
        assert plc.u == pytest.approx(LIMITS.u_safe)

        second = rig_on(plc)
        leave = second.make_safe

        def leave_in_vain() -> None:
            plc.reset_at = lambda request: moment
            leave()

        second.make_safe = leave_in_vain  # type: ignore[method-assign]
        with pytest.raises(LinkError, match=f"could not be confirmed .*{GO}"):
            session(second, recording.with_name("second.csv"), lambda tick: 0.2)


def test_a_rig_process_that_is_gone_ends_in_one_line(recording: Path) -> None:
    with ScanningPlc() as plc:

        def law(tick: Tick) -> float:
            if tick.k == 5:
                plc.__exit__(None, None, None)
            return 0.2

        with pytest.raises(LinkError, match=rf"no connection \(.*refused\)\. {GO}"):
            session(rig_on(plc), recording, law)
    assert len(read_recording(recording)) > 5


def test_a_driver_that_raises_what_it_likes_cannot_keep_a_session_from_ending(recording: Path) -> None:
    with ScanningPlc() as plc:
        rig = rig_on(plc)

        def broken(*_: object) -> None:
            raise BrokenPipeError("nobody there")

        def also_broken() -> None:
            raise RuntimeError("a driver's own")

        rig.write, rig.make_safe = broken, also_broken  # type: ignore[method-assign]
        with pytest.raises(LinkError, match=rf"the link failed \(nobody there\)\. {GO}"):
            session(rig, recording, lambda tick: 0.2)
    assert GO in ended(recording)["reason"]


# -- scans, sockets --


@pytest.mark.parametrize("late", [0, 1, 2, 3])
def test_a_status_some_scans_late_is_waited_for_and_tolerated(recording: Path, late: int) -> None:
    with ScanningPlc(scan_s=0.02, late=late) as plc:
        loop = session(rig_on(plc, scan_time_s=0.02), recording, lambda tick: 0.2 if tick.k % 2 else 0.1)
        assert plc.accepted == 1  # one connection, made once and kept
    assert loop.timing.unusable == 0
    assert ended(recording)["reason"] == "completed"


def test_a_plc_that_accepts_now_and_then_and_has_one_socket(recording: Path) -> None:
    with ScanningPlc(late=2, accept_s=0.1, sockets=1) as plc:
        for k in range(3):
            session(rig_on(plc), recording.with_name(f"{k}.csv"), lambda tick: 0.2)
        assert plc.accepted == 3


def test_a_program_that_does_not_run_is_said_and_not_taken_for_a_slow_one() -> None:
    with ScanningPlc(late=100) as plc:  # its status stands still
        rig = rig_on(plc)
        with pytest.raises(LinkError, match=r"echo the heartbeat after 0\.\d+ s.*whether its program runs"):
            rig.open()
        with pytest.raises(LinkError, match="does not echo the heartbeat of the safe output"):  # it holds nothing
            rig.make_safe()
        rig.close()


def test_an_echo_older_than_the_scans_allow_is_refused() -> None:
    with ScanningPlc(scan_s=0.02, late=3) as plc:
        rig = rig_on(plc, scan_time_s=0.001)

        def beats() -> None:
            rig.open()
            for k in range(50):
                rig.clock.sleep_until(rig.clock.now() + 0.02)
                rig.write(0.001 * k)
                rig.read()

        with pytest.raises(LinkError, match=r"(echoes heartbeat \d+, not|does not echo the heartbeat).*scan_time_s"):
            beats()
        rig.close()


# -- whoever else is there --


@contextmanager
def killed_host(plc: ScanningPlc, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Yield a process that commands the rig until it is killed."""
    code = (
        "import sys; from tests.drivers.scanning_plc import plc_settings; from tests.drivers.bench import rig_of\n"
        "rig = rig_of(plc_settings(int(sys.argv[1])))\n"
        "rig.open(); print('open', flush=True)\n"
        "while True: rig.write(0.3); rig.read(); rig.clock.sleep_until(rig.clock.now() + 0.02)\n"
    )
    root = Path(__file__).parents[2]
    environment = os.environ | {"TMPDIR": str(folder)}  # as on another computer: its lock is not ours
    with subprocess.Popen(
        [sys.executable, "-c", code, str(plc.port)], cwd=root, env=environment, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"open\n"
        try:
            yield child
        finally:
            child.kill()


def test_a_second_master_is_refused_before_it_has_written_anything(tmp_path: Path) -> None:
    with ScanningPlc() as plc, killed_host(plc, tmp_path):
        writes: list[bytes] = []
        own = rig_on(plc)
        plc.reset_at = lambda request: (writes.append(request), "")[1] if request[1] in (5, 6, 15, 16) else ""  # type: ignore[func-returns-value]
        envelope = Envelope(settings=LIMITS, sample_time_s=0.02)
        writer = RecordingWriter(tmp_path / "second.csv", ("t", "u", "y"), {})
        with pytest.raises(NotTaken, match="another master commands the rig: its heartbeat went from"):
            ControlLoop(rig=own, envelope=envelope, writer=writer).__enter__()
        assert plc.mode == "host"
        assert plc.u == pytest.approx(0.3)  # the first one's command stands
        assert not any(request[1] == 6 and request[3] in (2, 3) for request in writes)


def test_a_second_session_on_this_computer_is_refused_by_the_lock() -> None:
    with ScanningPlc() as plc:
        first, second = rig_on(plc), rig_on(plc)
        first.open()
        with pytest.raises(NotTaken, match="another session on this computer has the rig"):
            second.open()
        second.make_safe()
        second.close()
        first.read()  # undisturbed
        first.make_safe()
        first.close()
        second.open()
        second.make_safe()
        second.close()


def test_after_a_host_was_killed_the_next_one_takes_the_rig(tmp_path: Path, recording: Path) -> None:
    with ScanningPlc() as plc:
        with killed_host(plc, tmp_path) as child:
            child.send_signal(signal.SIGKILL)
            child.wait(LIMIT_S)
        plc.wait_for(lambda: plc.tripped)
        # enable is still 1, and the trip clears on its edge only
        session(rig_on(plc), recording, lambda tick: 0.2)
        assert 0.2 in [round(u, 3) for u in plc.commands]
    assert ended(recording)["reason"] == "completed"


# -- interlocks, hand-back --


def test_a_permissive_that_is_lost_stops_the_session_by_its_name(recording: Path) -> None:
    with ScanningPlc() as plc:

        def law(tick: Tick) -> float:
            if tick.k == 5:
                plc.door = 0
            return 0.2

        with pytest.raises(ExperimentStopped, match=r"permissive 'guard door' is lost: it reads 0") as stop:
            session(rig_on(plc, permissives=[DOOR]), recording, law)
        assert stop.value.exit_status == 3
        plc.settle()
        assert plc.u == pytest.approx(LIMITS.u_safe)
        with pytest.raises(NotTaken, match=r"permissive 'guard door' is missing"):
            rig_on(plc, permissives=[DOOR]).open()


def test_a_permissive_has_a_range() -> None:
    from autotune.config.rig import PermissiveSettings

    pressure = PermissiveSettings.model_validate({"name": "oil", "address": 1, "at_least": 2.0, "at_most": 6.0})
    assert [pressure.holds(value) for value in (1.9, 2.0, 6.0, 6.1, float("nan"))] == [False, True, True, False, False]
    closed = PermissiveSettings.model_validate({"name": "valve", "table": "coil", "address": 1, "at_most": 0.0})
    assert closed.holds(0.0)
    assert not closed.holds(1.0)


@contextmanager
def in_automatic(**changes: Any) -> Iterator[ScanningPlc]:
    """Yield a PLC whose own controller holds 0.4 already."""
    with ScanningPlc(late=2, **changes) as plc:
        plc.holding[3:5] = [1, 400]
        plc.u = plc.y = 0.4
        yield plc


def test_the_controller_gets_mode_and_setpoint_back_without_a_bump(recording: Path) -> None:
    with in_automatic() as plc:
        session(rig_on(plc), recording, lambda tick: 0.3)
        assert plc.mode == "controller"
        assert plc.holding[2:5] == [0, 1, 400]
        assert plc.u == pytest.approx(0.3, abs=0.05)  # from the last command on
    assert ended(recording)["output"] == "handed back to its own controller: automatic at set-point 0.4"


def test_an_operator_who_stops_the_session_gets_the_controller_back_too(recording: Path) -> None:
    with in_automatic() as plc:

        def law(tick: Tick) -> float:
            if tick.k == 5:
                signal.raise_signal(signal.SIGTERM)
            return 0.3

        with pytest.raises(OperatorStop):
            session(rig_on(plc), recording, law)
        assert plc.mode == "controller"


def test_after_a_fault_the_rig_is_safe_and_the_line_says_that_the_controller_is_not_back(recording: Path) -> None:
    with in_automatic() as plc:

        def law(tick: Tick) -> float:
            if tick.k == 5:
                raise ExperimentStopped("limit reached")
            return 0.3

        with pytest.raises(
            ExperimentStopped, match=r"limit reached\. Its own controller was in automatic at set-point 0\.4 before"
        ):
            session(rig_on(plc), recording, law)
        plc.settle()
        assert plc.u == pytest.approx(LIMITS.u_safe)
    assert "was not restored" in ended(recording)["note"]


def test_a_hand_back_that_fails_is_said_and_the_rig_made_safe(recording: Path) -> None:
    with in_automatic() as plc:
        rig = rig_on(plc)
        assert isinstance(rig, HandsBack)

        def refused() -> None:
            raise LinkError("the controller's mode is locked")

        rig.hand_back = refused  # type: ignore[method-assign]  # a key switch at the panel
        loop = session(rig, recording, lambda tick: 0.3)
        plc.settle()
        assert plc.u == pytest.approx(LIMITS.u_safe)
    assert "was not restored" in loop.metadata["ended"]["note"]


def test_the_deadman_is_fed_while_the_host_waits_for_a_slow_sample(recording: Path) -> None:
    with ScanningPlc(deadman_s=0.5) as plc:
        envelope = Envelope(settings=LIMITS, sample_time_s=1.2)
        writer = RecordingWriter(recording, ("t", "u", "y"), {})
        with ControlLoop(rig=rig_on(plc), envelope=envelope, writer=writer) as loop:
            loop.step(0.2)
            loop.step(0.1)
            assert not plc.tripped


def test_what_the_device_says_it_applies_is_a_column_of_the_recording_where_it_is_mapped() -> None:
    with ScanningPlc() as plc:
        assert further_columns(rig_on(plc)) == ("u_applied",)
        bare = REGISTERS.model_copy(update={"u_applied": None})
        assert further_columns(rig_of(tcp_settings(plc.port, bare))) == ()


def test_a_lock_leaves_no_file_and_lets_one_session_in() -> None:
    first, second = SessionLock("a rig of this test"), SessionLock("a rig of this test")
    assert first.take()
    with pytest.raises(LinkError, match="another session on this computer"):
        second.take()
    path = first._path
    first.give_back()
    assert not path.exists()
    assert second.take()
    assert path.exists()
    second.give_back()
    assert not path.exists()


def test_a_lock_lies_where_no_other_user_can_put_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    tmp_path.chmod(0o700)
    lock = SessionLock("a rig of this test")
    assert lock.take()
    assert lock._path.parent == tmp_path
    lock.give_back()
    tmp_path.chmod(0o777)  # the system's folder is open to others: one of its own is made
    assert lock.take()
    own = lock._path.parent
    assert own.parent == tmp_path
    assert own.stat().st_mode & 0o777 == 0o700
    lock.give_back()
    own.chmod(0o777)
    with pytest.raises(LinkError, match="others can write to it"):
        lock.take()
    own.rmdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    own.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(LinkError, match="belongs to somebody else"):
        lock.take()
