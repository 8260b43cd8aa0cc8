"""How files come to be damaged: by editors, exports, disks, languages, and by people who mean it."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable
from typing import Any

import tomli_w

NUMBERS: tuple[Any, ...] = (
    0, -0.0, 1, -1, 0.5, 1e-308, -1e-308, 5e-324, 1e-300, 1e300, 1.7976931348623157e308, 1e16, -1e16, 1e-9, 1e9,
    float("nan"), float("inf"), float("-inf"), 10**400, -(10**400), 2**31, 2**63, 65536, 1e-3, 1e6, 12, -100.0,
)  # fmt: skip
OTHERS: tuple[Any, ...] = (
    "", "x", "1", "1_000", "nan", "[/foo]", "<img src=x onerror=alert(1)>", "\x1b[2J", "ä" * 5, "x" * 300, "a/b",
    "../a", "°C", "\u202e", True, False, [], [[]], {}, [1], [0.0], {"a": 1}, [{}], ["x"], None,
)  # fmt: skip
#: a value that is repeated takes no more than about so many characters; indented by depth it takes a hundred times more
LARGEST = 20_000


def places(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the path of every value in nested tables and lists, the root left out."""
    found = [path] if path else []
    if len(path) > 8:
        return found
    entries: Any = (
        content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    )
    for key, value in entries:
        found += places(value, (*path, key))
    return found


def damaged_content(rng: random.Random, content: Any) -> Any:
    """Return a copy in which one to three values or keys were changed."""
    content = copy.deepcopy(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        known = places(content)
        if not known:
            return content
        *above, key = rng.choice(known)
        table = content
        for step in above:
            table = table[step]
        way = rng.random()
        if way < 0.45:
            table[key] = rng.choice(NUMBERS)
        elif way < 0.65:
            table[key] = copy.deepcopy(rng.choice(OTHERS))
        elif way < 0.75:
            del table[key]
        elif way < 0.85 and isinstance(table, dict):
            table[rng.choice((f"{key}_", "Td", "x", "", "ä", "\x1b", "x" * 300))] = table.pop(key)
        elif isinstance(table, list):
            times, size = rng.choice((1, 2, 60, 2000)), len(repr(table[key]))
            # each a copy of its own: a later change in one that all share would multiply
            table[key:key] = [copy.deepcopy(table[key]) for _ in range(min(times, max(1, LARGEST // size)))]
        else:
            value: Any = 1
            for _ in range(rng.choice((3, 40, 200))):
                value = [value]
            table[key] = value
    return content


def damaged_bytes(rng: random.Random, data: bytes) -> bytes:
    """Return the bytes of a file as a disk, an editor or a transfer may leave them."""
    ways: tuple[Callable[[], bytes], ...] = (
        lambda: data[: rng.randrange(len(data) + 1)],
        lambda: b"",
        lambda: bytes(b ^ (1 << rng.randrange(8)) if rng.random() < 0.01 else b for b in data),
        lambda: rng.randbytes(rng.randrange(2000)),
        lambda: b"# Beh\xe4lter 20 \xb0C\n" + data,
        lambda: data.decode(errors="replace").encode("utf-16"),
        lambda: b"\xef\xbb\xbf" + data,
        lambda: data.replace(b"\n", b"\r\n"),
        lambda: data.replace(b"\n", b"\r"),
        lambda: data.replace(b",", b";"),
        lambda: data.replace(b".", b","),
        lambda: data.replace(
            b"0", rng.choice((b"_0", b"NaN", b"inf", b"", b"-", b"1e400", b"\x00")), rng.randrange(1, 9)
        ),
        lambda: data.replace(b"=", b"=" + b"[" * rng.choice((5, 100, 100_000)), 1),
        lambda: data.replace(b"{", b"[" * rng.choice((5, 100, 100_000)), 1),
        lambda: data + data,
        lambda: _cut(rng, data),
        lambda: _swapped(rng, data),
        lambda: data + b"\x1b[2J\x07",
    )
    return rng.choice(ways)()


def _cut(rng: random.Random, data: bytes) -> bytes:
    i, j = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:i] + data[j:]


def _swapped(rng: random.Random, data: bytes) -> bytes:
    lines = data.splitlines(keepends=True) or [b""]
    for _ in range(rng.choice((1, 3, 20))):
        i, j = (rng.randrange(len(lines)) for _ in range(2))
        lines[i], lines[j] = lines[j], lines[i]
    return b"".join(lines)


def damaged_toml(rng: random.Random, content: dict[str, Any]) -> bytes:
    """Return a TOML file whose content or bytes are damaged."""
    for _ in range(5):
        if rng.random() < 0.7:
            try:
                return tomli_w.dumps(damaged_content(rng, content)).encode(errors="surrogatepass")
            except (TypeError, ValueError, RecursionError, OverflowError):
                continue  # TOML has no such value
        return damaged_bytes(rng, tomli_w.dumps(content).encode())
    return b""


def damaged_json(rng: random.Random, content: dict[str, Any]) -> bytes:
    """Return a JSON file whose content or bytes are damaged."""
    if rng.random() < 0.75:
        try:
            return json.dumps(damaged_content(rng, content)).encode()
        except (ValueError, RecursionError):
            return b"[" * 100_000
    return damaged_bytes(rng, json.dumps(content).encode())


CELLS = (
    "", "nan", "NaN", "inf", "-inf", "1_000", "x", "1e400", "-", "0x10", "1,5", "1e-320", "°", "1 000", "--1", "Bad",
    "#", "\x1b[2J", "99999999999999999999", "1e300", "1e18",
)  # fmt: skip
HEADERS = (
    "t,u,y",
    "t,u",
    "u,y,t",
    "t;u;y",
    "time,u,y",
    "t,u,y,y",
    "t,u,y,[/foo]",
    "t,u,y,\x1b[2J",
    "",
    "1,2,3",
    "t,u,y," + "x" * 300,
)


def damaged_csv(rng: random.Random, text: str) -> bytes:
    """Return a recording whose cells, rows, header or bytes are damaged."""
    lines = text.splitlines()
    way = rng.random()
    if way < 0.15:
        return damaged_bytes(rng, text.encode())
    if way < 0.25:
        lines[0] = rng.choice(HEADERS)
    elif way < 0.6:
        for _ in range(rng.choice((1, 1, 3, 30, 300))):
            i = rng.randrange(1, len(lines))
            cells = lines[i].split(",")
            cells[rng.randrange(len(cells))] = rng.choice(CELLS)
            lines[i] = ",".join(cells)
    elif way < 0.85:  # a whole column
        column, value = rng.randrange(3), rng.choice((*CELLS, "0", "1", "1e9"))
        rows = [line.split(",") for line in lines]
        for i, row in enumerate(rows[1:]):
            if column < len(row):
                row[column] = value if column or rng.random() < 0.5 else str(i * 10 ** rng.choice((-9, 0, 6)))
        lines = [",".join(row) for row in rows]
    else:
        lines = lines[: rng.choice((1, 2, 3, 10, 60))]
    return ("\n".join(lines) + rng.choice(("\n", ""))).encode(
        rng.choice(("utf-8", "utf-8", "cp1252")), errors="replace"
    )
