from __future__ import annotations

import asyncio
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.types import Message, Receive, Scope, Send

from autotune.errors import InputError
from autotune.live.server import Guard, listening, token_for
from autotune.run_log import RunLog
from tests.autotune.experiment.rigs import ball_config

TOKEN = "word-of-this-run"


async def inner(scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
    else:
        await send({"type": "http.response.start", "status": 200, "headers": []})


def answer(kind: str, *, query: str = "", loopback: bool = True, **headers: str) -> Message:
    """Return the first message that the guarded application sends back."""
    sent: list[Message] = []

    async def send(message: Message) -> None:
        sent.append(message)

    async def receive() -> Message:
        return {"type": "websocket.connect"}

    scope: dict[str, Any] = {
        "type": kind,
        "query_string": query.encode(),
        "headers": [(name.encode(), value.encode("latin-1")) for name, value in headers.items()],
        "extensions": {"websocket.http.response": {}},
    }
    asyncio.run(Guard(inner, TOKEN, loopback=loopback)(scope, receive, send))
    return sent[0]


def gets_in(kind: str, *, token: str = TOKEN, **asked: Any) -> bool:
    first = answer(kind, query=f"token={token}", **asked)
    refused = first.get("status") == 403 or first["type"] == "websocket.close"
    assert refused or first.get("status") == 200 or first["type"] == "websocket.accept"
    return not refused


def test_there_is_always_a_token_and_one_that_cannot_be_guessed() -> None:
    assert token_for("word-of-mine-alone") == "word-of-mine-alone"
    made = {token_for(None) for _ in range(100)}
    assert len(made) == 100
    assert min(map(len, made)) >= 20
    for poor in ("", "short", "fifteen-letters", "with blank in it all", "semi;colon-in-it-all", "x" * 300):
        with pytest.raises(InputError, match="the token"):
            token_for(poor)


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_on_loopback_the_page_itself_gets_in_and_neither_another_user_nor_a_foreign_page_does(kind: str) -> None:
    here = "127.0.0.1:8080"
    assert gets_in(kind, host=here)
    assert gets_in(kind, host=here, origin=f"http://{here}")
    assert gets_in(kind, host="[::1]:8080")
    assert not gets_in(kind, host=here, token="")
    assert not gets_in(kind, host=here, token="guess")
    assert not gets_in(kind, host="rebound.example:8080")  # a foreign name that resolves to this machine
    assert not gets_in(kind, host="rebound.example:8080", origin="http://rebound.example:8080")
    assert not gets_in(kind, host=here, origin="http://elsewhere.example")
    assert not gets_in(kind, host=here, origin="http://127.0.0.1:9090")


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_who_was_given_the_token_stays_in_by_a_cookie(kind: str) -> None:
    there = "10.0.0.5:8080"
    asked: dict[str, Any] = {"host": there, "loopback": False}
    assert not gets_in(kind, token="guess", **asked)
    assert not gets_in(kind, **asked, origin="http://elsewhere.example")
    assert gets_in(kind, **asked)
    cookie = dict(answer("http", query=f"token={TOKEN}", **asked)["headers"])[b"set-cookie"].decode()
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert gets_in(kind, token="", cookie=cookie.split(";")[0], **asked)


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    ("header", "value"),
    [
        ("host", "[::1"), ("host", "127.0.0.1:port"), ("host", "127.0.0.1:99999999"), ("host", ""), ("host", "ä\\]"),
        ("origin", "http://[::1"), ("origin", "null"), ("origin", "\x01"), ("cookie", "a=b; =; \x00[;;"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_and_is_no_traceback(kind: str, header: str, value: str) -> None:
    headers = {"host": "127.0.0.1:8080"} | {header: value}
    first = answer(kind, **headers)  # without the token: a cookie must not let in either
    assert first.get("status") == 403 or first["type"] == "websocket.close"


@settings(max_examples=150, deadline=None)
@given(
    host=st.text(st.characters(max_codepoint=255), max_size=30),
    origin=st.text(st.characters(max_codepoint=255), max_size=30),
    cookie=st.text(st.characters(max_codepoint=255), max_size=60),
    query=st.text(st.characters(max_codepoint=127), max_size=40),
)
def test_nobody_gets_in_by_chance(host: str, origin: str, cookie: str, query: str) -> None:
    first = answer("http", host=host, origin=origin, cookie=cookie, query=query, loopback=False)
    assert first["status"] == 403


def test_the_browser_is_told_to_load_nothing_from_elsewhere() -> None:
    first = answer("http", host="localhost:80", query=f"token={TOKEN}")
    policy = dict(first["headers"])[b"content-security-policy"].decode()
    assert "default-src 'self'" in policy
    assert "http" not in policy


def test_an_address_that_cannot_be_listened_on_is_refused_with_the_remedy() -> None:
    with listening("127.0.0.1", 0) as taken:
        taken.listen()
        with pytest.raises(InputError, match="another --listen or --port"):
            listening("127.0.0.1", taken.getsockname()[1])


def ask(port: int, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=20) as line:
        line.sendall(request)
        if not request.endswith(b"\r\n\r\n"):
            line.shutdown(socket.SHUT_WR)
        answered = b""
        while part := line.recv(65536):
            answered += part
        return answered


def test_a_served_page_refuses_other_users_counts_them_and_stays_quiet(tmp_path: Path) -> None:
    with RunLog(tmp_path / "progress.jsonl") as log:
        log.begin(ball_config().model_copy(update={"name": "<img src=x onerror=alert(1)>"}))
    command = [sys.executable, "-m", "autotune", "live", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    url = urlsplit(process.stdout.readline().split()[-1])
    port, here = url.port or 0, f"127.0.0.1:{url.port}"
    head = f"Host: {here}\r\nConnection: close\r\n".encode()
    page = ask(port, f"GET {url.path}?{url.query} HTTP/1.1\r\n".encode() + head + b"\r\n")
    assert page.startswith(b"HTTP/1.1 200")
    assert b"<img src=x" not in page
    assert b"&lt;img src=x" in page.replace(b"\\u0026", b"&").replace(b"\\u003c", b"<").replace(b"&amp;lt;", b"&lt;")
    for request in (
        b"GET / HTTP/1.1\r\n" + head + b"\r\n",
        b"GET /?token=guess HTTP/1.1\r\n" + head + b"\r\n",
        b"GET / HTTP/1.1\r\nHost: [::1\r\nConnection: close\r\n\r\n",
        b"GET /_nicegui_ws/socket.io/?EIO=4&transport=polling HTTP/1.1\r\n" + head + b"\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: -1\r\n" + head + b"\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
    ):
        assert not ask(port, request).startswith(b"HTTP/1.1 200")
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert said.strip() in ("", "autotune: stopped by the operator; nothing was written")


def test_after_twenty_wrong_tokens_none_is_looked_at_for_a_minute_and_who_is_in_stays_in() -> None:
    now = [0.0]
    guard = Guard(inner, TOKEN, loopback=True, clock=lambda: now[0])

    def status(query: str = "", cookie: str = "") -> int:
        sent: list[Message] = []

        async def send(message: Message) -> None:
            sent.append(message)

        async def receive() -> Message:
            return {"type": "http.request"}

        headers = {"host": "127.0.0.1:8080", "cookie": cookie}
        scope = {
            "type": "http",
            "query_string": query.encode(),
            "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
        }
        asyncio.run(guard(scope, receive, send))
        return int(sent[0]["status"])

    assert {status(f"token=guess-{i}") for i in range(20)} == {403}
    assert status(f"token={TOKEN}") == 403
    assert status(cookie=f"autotune_live_8080={TOKEN}") == 200
    now[0] = 61.0
    assert status(f"token={TOKEN}") == 200


def test_plain_http_is_not_served_beyond_loopback() -> None:
    with pytest.raises(InputError, match=r"plain HTTP.*ssh -L 8080:127\.0\.0\.1:8080"):
        listening("0.0.0.0", 8080)
