from __future__ import annotations

import asyncio
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from autotune.errors import InputError
from autotune.live.server import Guard, listening, token_for


async def inner(scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
    else:
        await send({"type": "http.response.start", "status": 200, "headers": []})


def answer(kind: str, token: str | None, *, query: str = "", **headers: str) -> Message:
    """Return the first message that the guarded application sends back."""
    sent: list[Message] = []

    async def send(message: Message) -> None:
        sent.append(message)

    async def receive() -> Message:
        return {"type": "websocket.connect"}

    scope: dict[str, Any] = {
        "type": kind,
        "query_string": query.encode(),
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
        "extensions": {"websocket.http.response": {}},
    }
    asyncio.run(Guard(inner, token)(scope, receive, send))
    return sent[0]


def gets_in(kind: str, token: str | None, **asked: str) -> bool:
    first = answer(kind, token, **asked)
    refused = first.get("status") == 403 or first["type"] == "websocket.close"
    assert refused or first.get("status") == 200 or first["type"] == "websocket.accept"
    return not refused


def test_loopback_needs_no_token_and_another_address_always_has_one() -> None:
    assert token_for("127.0.0.1", None) is None
    assert token_for("localhost", "word") == "word"
    made = token_for("0.0.0.0", None)
    assert made is not None
    assert len(made) >= 16


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_on_loopback_the_page_itself_gets_in_and_a_foreign_page_does_not(kind: str) -> None:
    here = "127.0.0.1:8080"
    assert gets_in(kind, None, host=here)
    assert gets_in(kind, None, host=here, origin=f"http://{here}")
    assert gets_in(kind, None, host="[::1]:8080")
    assert not gets_in(kind, None, host="rebound.example:8080")  # a foreign name that resolves to this machine
    assert not gets_in(kind, None, host="rebound.example:8080", origin="http://rebound.example:8080")
    assert not gets_in(kind, None, host=here, origin="http://elsewhere.example")
    assert not gets_in(kind, None, host=here, origin="http://127.0.0.1:9090")


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_with_a_token_only_who_was_given_it_gets_in_and_stays_in_by_a_cookie(kind: str) -> None:
    there = "10.0.0.5:8080"
    assert not gets_in(kind, "secret", host=there)
    assert not gets_in(kind, "secret", host=there, query="token=guess")
    assert not gets_in(kind, "secret", host=there, query="token=secret", origin="http://elsewhere.example")
    assert gets_in(kind, "secret", host=there, query="token=secret")
    cookie = dict(answer("http", "secret", host=there, query="token=secret")["headers"])[b"set-cookie"].decode()
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert gets_in(kind, "secret", host=there, cookie=cookie.split(";")[0])


def test_the_browser_is_told_to_load_nothing_from_elsewhere() -> None:
    policy = dict(answer("http", None, host="localhost:80")["headers"])[b"content-security-policy"].decode()
    assert "default-src 'self'" in policy
    assert "http" not in policy


def test_an_address_that_cannot_be_listened_on_is_refused_with_the_remedy() -> None:
    with listening("127.0.0.1", 0) as taken:
        taken.listen()
        with pytest.raises(InputError, match="another --listen or --port"):
            listening("127.0.0.1", taken.getsockname()[1])
