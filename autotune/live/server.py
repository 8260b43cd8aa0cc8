"""Serves the page from local files to whoever has the token, on loopback as well: other users reach that too."""

from __future__ import annotations

import logging
import os
import re
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import uvicorn
from fastapi import FastAPI
from nicegui import app as pages
from nicegui import ui
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from autotune.errors import InputError
from autotune.live.controls import Controls
from autotune.live.page import Screen, build
from autotune.live.requests import BoundedConnection
from autotune.live.story import Story

LOOPBACK = ("127.0.0.1", "::1", "localhost")
#: time between two looks at the files [s]
POLL_S = 0.2
#: time without any open page after which the page of a finished run is no longer served [s]; a reload takes less
LINGER_S = 1.5
#: nothing from anywhere else is loaded, no other page may frame this one; the page's library compiles templates
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline';"
    " img-src 'self' data:; font-src 'self' data:; frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
)


#: wrong tokens that are looked at, and the time [s] in which so many close the door to further ones
MOST_GUESSES, LOCKED_S = 20, 60.0


class Guard:
    """Lets requests through that come from the page itself and from whoever has the token.

    Other users of the machine reach a loopback address as well as its owner does, so there is a token everywhere. On
    loopback the name that was asked for must also be a loopback name: a foreign page that has its own name resolved to
    this machine is refused. A request of a foreign origin is refused everywhere, and so is one that cannot be read.

    Parameters
    ----------
    inner : ASGI application
        What is guarded.
    token : str
        What must be in the address once; it is kept in a cookie then.
    loopback : bool
        Whether the page is served on loopback only.
    clock : callable
        Time [s]; after :data:`MOST_GUESSES` wrong tokens within :data:`LOCKED_S` none is looked at.

    Attributes
    ----------
    refused : int
        Requests that were refused.
    """

    def __init__(
        self, inner: ASGIApp, token: str, *, loopback: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._inner, self._token, self._loopback = inner, token, loopback
        self._clock, self._wrong_s = clock, list[float]()
        self.refused = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it with 403."""
        if scope["type"] not in ("http", "websocket"):
            await self._inner(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        given = ""
        try:
            given = parse_qs(scope["query_string"].decode("latin-1"), max_num_fields=100).get("token", [""])[0]
            allowed = self._is_allowed(headers, given)
        except (ValueError, CookieError):  # a host, an origin, a cookie or a query that is none
            allowed = False
        if not allowed:
            self.refused += 1
            await PlainTextResponse("refused: open the address that the command has printed", 403)(scope, receive, send)
            return

        async def answered(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), (b"content-security-policy", POLICY.encode())]
                if given:
                    kept = f"{_cookie(headers['host'])}={self._token}; HttpOnly; SameSite=Strict; Path=/"
                    message["headers"].append((b"set-cookie", kept.encode()))
            await send(message)

        await self._inner(scope, receive, answered)

    def _is_allowed(self, headers: dict[str, str], given: str) -> bool:
        host, origin = headers.get("host", ""), headers.get("origin")
        hostname = urlsplit(f"//{host}").hostname
        if not hostname or (self._loopback and hostname not in LOOPBACK):
            return False
        if origin is not None and urlsplit(origin).netloc != host:
            return False
        cookie = SimpleCookie(headers.get("cookie", "")).get(_cookie(host))
        if cookie is not None and self._is_token(cookie.value):
            return True  # who is in stays in, whoever guesses
        return bool(given) and self._is_heard() and self._is_token(given)

    def _is_token(self, word: str) -> bool:
        right = secrets.compare_digest(word.encode(), self._token.encode())
        if not right and word:
            self._wrong_s = [*self._wrong_s[1 - MOST_GUESSES :], self._clock()]
        return right

    def _is_heard(self) -> bool:
        """Return whether a guess is looked at: not after so many wrong ones within a minute."""
        return len(self._wrong_s) < MOST_GUESSES or self._clock() - self._wrong_s[0] > LOCKED_S


class Refusals(logging.Handler):
    """Counts what the server's libraries say of malformed requests and messages, in place of their tracebacks."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Count it."""
        self.count += record.levelno >= logging.WARNING

    def attach(self) -> None:
        """Take over from the libraries that speak of connections."""
        for name in ("uvicorn", "uvicorn.error", "uvicorn.asgi", "asyncio", "engineio", "socketio", "websockets"):
            logger = logging.getLogger(name)
            logger.handlers, logger.propagate = [self], False


def _cookie(host: str) -> str:
    """Return the name of the cookie: cookies are shared between the ports of a machine."""
    return f"autotune_live_{urlsplit(f'//{host}').port or 80}"


def token_for(given: str | None) -> str:
    """Return the token that visitors need: the given one, else a new one.

    Raises
    ------
    InputError
        One that an address or a cookie cannot hold, or that is guessed soon.
    """
    if given is None:
        return secrets.token_urlsafe(16)
    if not re.fullmatch(r"[A-Za-z0-9_-]{16,200}", given):
        raise InputError("cannot be used", where="the token", remedy="give 16 to 200 letters, digits, - and _")
    return given


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens on this machine alone.

    Parameters
    ----------
    host : str
        An address of this machine.
    port : int
        TCP port; 0 takes a free one.

    Raises
    ------
    InputError
        The address is beyond loopback, not this machine's, or the port is taken.
    """
    if host not in LOOPBACK:
        raise InputError(
            "the page is plain HTTP, which anybody between could read", where=f"--listen {host}",
            remedy=f"leave it out and come by way of ssh -L {port or 'PORT'}:127.0.0.1:{port or 'PORT'}",
        )  # fmt: skip
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise InputError(
            f"cannot be listened on ({error.strerror})",
            where=f"{host}:{port}",
            remedy="give another --listen or --port",
        ) from None


def serve(folder: Path, bound: socket.socket, token: str, run: Run | None = None) -> None:
    """Serve the page of a run's folder until Ctrl-C, or with a ``run`` until that is over and no page is open.

    Parameters
    ----------
    folder : Path
        Of a run that goes on, or has ended.
    bound : socket
        From :func:`listening`.
    token : str
        From :func:`token_for`.
    run : Run, optional
        The run that listens to the page.
    """
    story, screens = Story(folder), set[Screen]()
    controls = Controls(run.act if run is not None else None)
    story.poll()
    shell = FastAPI()
    ui.page("/", title="autotune live")(build(story, controls, screens))
    ui.run_with(
        shell, dark=None, tailwind=False, show_welcome_message=False, message_history_length=50, language="en-US"
    )
    guard, refusals = Guard(shell, token, loopback=bound.getsockname()[0] in LOOPBACK), Refusals()
    settings = uvicorn.Config(
        guard, http=BoundedConnection, log_config=None, ws_per_message_deflate=False, timeout_graceful_shutdown=1
    )
    refusals.attach()
    server = uvicorn.Server(settings)
    looked_s = time.monotonic()

    def look() -> None:
        nonlocal looked_s
        story.poll()
        tabs = {screen.tab for screen in screens if screen.tab is not None}
        controls.present(tabs)
        controls.refused = guard.refused + refusals.count
        for screen in list(screens):
            screen.update()
        over = run is not None and run.is_over
        controls.run_is_gone = over and story.ended is None
        looked_s = looked_s if over and not any(screen.is_connected for screen in screens) else time.monotonic()
        server.should_exit = server.should_exit or time.monotonic() - looked_s > LINGER_S

    pages.timer(POLL_S, look)
    server.run(sockets=[bound])


class Run:
    """The run that started this process: it hears actions on one pipe, and another pipe ends with it.

    Its own output goes where errors go, so that nothing but actions is in the pipe.
    """

    def __init__(self) -> None:
        self._actions = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1, encoding="utf-8")
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        self._over = threading.Event()
        threading.Thread(target=self._wait_for_end, daemon=True).start()

    def act(self, action: str) -> None:
        """Tell the run; one that is gone hears nothing."""
        try:
            self._actions.write(f"{action}\n")
        except OSError:
            self._over.set()

    @property
    def is_over(self) -> bool:
        """Whether the run has ended."""
        return self._over.is_set()

    def _wait_for_end(self) -> None:
        while sys.stdin.buffer.read(1):
            pass
        self._over.set()
