"""Connections to served twins that ask nothing end; a master that asks, often or seldom, keeps its own."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

import sim.opcua_rig
from autotune.cli.served import serve_opcua
from autotune.config.rig import OpcUaSettings
from sim.bounded_connection import BoundedConnection
from sim.modbus_rig import ModbusRig, TcpTransport
from tests.drivers.bench import register_device
from tests.drivers.test_opcua import ball

#: read holding register 0 of unit 1 (Modbus application protocol 1.1b3, 6.3, in the frame of Modbus on TCP/IP)
WHOLE = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
#: connections of this machine
TABLE = Path("/proc/net/tcp")
#: within it every connection that should end has ended [s]
WAIT_S = 20.0


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    monkeypatch.setattr(BoundedConnection, "patience_s", 0.2)
    monkeypatch.setattr(BoundedConnection, "most", 20)
    with ModbusRig(register_device(), TcpTransport()) as server:
        yield server.port


def opened(port: int, sent: bytes) -> socket.socket:
    line = socket.create_connection(("127.0.0.1", port), timeout=WAIT_S)
    line.sendall(sent)
    return line


def answer(line: socket.socket) -> bytes:
    """Return all that comes until the other side ends the connection."""
    answered = b""
    with contextlib.suppress(ConnectionResetError):
        while part := line.recv(65536):
            answered += part
    return answered


@pytest.mark.parametrize("sent", [b"", WHOLE[:3], WHOLE[:-1]])
def test_a_connection_that_brings_no_whole_request_is_ended(port: int, sent: bytes) -> None:
    with opened(port, sent) as line:
        assert answer(line) == b""


def test_half_a_request_after_a_whole_one_is_ended_too(port: int) -> None:
    with opened(port, WHOLE) as line:
        assert len(line.recv(64)) == 11
        line.sendall(WHOLE[:5])
        assert answer(line) == b""


def test_a_master_that_asks_seldom_is_answered_on_the_same_connection(port: int) -> None:
    with opened(port, WHOLE) as seldom:
        assert len(seldom.recv(64)) == 11
        for _ in range(3):  # each of these waits out the patience with another connection
            with opened(port, b"") as idle:
                assert answer(idle) == b""
        seldom.sendall(WHOLE)
        assert len(seldom.recv(64)) == 11


def test_of_too_many_that_ask_nothing_the_oldest_makes_room(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BoundedConnection, "patience_s", 1000.0)
    with contextlib.ExitStack() as all_lines:
        waiting = [all_lines.enter_context(opened(port, WHOLE[:3])) for _ in range(BoundedConnection.most + 1)]
        with opened(port, WHOLE) as asking:
            assert len(asking.recv(64)) == 11
        assert answer(waiting[0]) == b""
        waiting[-1].sendall(WHOLE[3:])
        assert len(waiting[-1].recv(64)) == 11


@pytest.mark.skipif(not TABLE.exists(), reason="the system's table of connections is Linux's")
def test_whether_a_silent_peer_is_still_there_is_asked(port: int) -> None:
    with opened(port, WHOLE) as line:
        assert len(line.recv(64)) == 11
        rows = [row.split() for row in TABLE.read_text().splitlines()[1:]]
        # local address, remote address, state (01 established), queues, timer (02 keep-alive): see proc(5)
        timers = [row[5][:2] for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "01"]
    assert timers == ["02"]


def test_an_opc_ua_connection_without_a_session_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sim.opcua_rig, "PATIENCE_S", 0.2)
    config = ball(tmp_path, secured=False)
    assert isinstance(config.rig, OpcUaSettings)
    port = int(config.rig.endpoint.rsplit(":", 1)[1].rstrip("/"))
    with serve_opcua(config, config.rig), opened(port, b"HELF") as line:
        assert answer(line) == b""
