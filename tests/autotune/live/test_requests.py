"""Connections that ask nothing end; whoever asks is answered, beside many of them and after a long time."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Iterator

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from autotune.live.requests import BoundedConnection

WHOLE = b"GET / HTTP/1.1\r\nHost: here\r\nConnection: close\r\n\r\n"
#: time that an answer takes: several times the patience with who asks nothing [s]
ANSWER_S = 1.0


class Hasty(BoundedConnection):
    """With bounds that a test can reach."""

    patience_s = 0.2
    most = 20


async def slow(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer after many times the patience; a request with a body once that has come."""
    while (await receive()).get("more_body"):
        pass
    await asyncio.sleep(ANSWER_S)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"4")]})
    await send({"type": "http.response.body", "body": b"told"})


@pytest.fixture
def port() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as bound:
        server = uvicorn.Server(
            uvicorn.Config(slow, http=Hasty, lifespan="off", log_config=None, timeout_graceful_shutdown=1)
        )
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        yield bound.getsockname()[1]
        server.should_exit = True
        thread.join()


def opened(port: int, sent: bytes) -> socket.socket:
    line = socket.create_connection(("127.0.0.1", port), timeout=20.0)
    line.sendall(sent)
    return line


def answer(line: socket.socket) -> bytes:
    """Return all that comes until the other side ends the connection."""
    answered = b""
    try:
        while part := line.recv(65536):
            answered += part
    except ConnectionResetError:
        pass
    return answered


@pytest.mark.parametrize(
    "sent",
    [
        b"", b"GET", WHOLE[:-2], b"POST / HTTP/1.1\r\nHost: here\r\nContent-Length: 9\r\n\r\nhalf",
        b"POST / HTTP/1.1\r\nHost: here\r\nTransfer-Encoding: chunked\r\n\r\n4\r\nhalf",
    ],
)  # fmt: skip
def test_a_connection_that_brings_no_whole_request_is_ended(port: int, sent: bytes) -> None:
    with opened(port, sent) as line:
        assert answer(line) == b""


def test_half_a_request_after_a_whole_one_is_ended_too(port: int) -> None:
    with opened(port, WHOLE.replace(b"Connection: close\r\n", b"") + WHOLE[:9]) as line:
        assert answer(line).endswith(b"\r\n\r\ntold")


def test_a_request_that_takes_long_to_answer_is_answered(port: int) -> None:
    with opened(port, WHOLE) as line:
        assert answer(line).endswith(b"told")


def test_of_too_many_that_wait_the_oldest_makes_room_and_a_request_beside_them_is_answered(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Hasty, "patience_s", 1000.0)
    with contextlib.ExitStack() as all_lines:
        waiting = [all_lines.enter_context(opened(port, b"GET")) for _ in range(Hasty.most)]
        with opened(port, WHOLE) as asking:
            assert answer(asking).endswith(b"told")
        assert answer(waiting[0]) == b""
        for line in waiting[1:]:
            line.settimeout(0.0)
            with pytest.raises(BlockingIOError):
                line.recv(1)
