"""Text files that come in: one place that decodes, parses and bounds TOML and JSON, and names what is wrong.

TOML and JSON are UTF-8 by their own definitions. A file that an editor saved in the code page of an old Windows
(cp1252) or in Latin-1 is refused with the line that shows it: a guess could turn one unit or name into another.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from autotune.errors import InputError

#: Longest settings, model or result file that is read [byte]; 100,000 frequency points take 20 MB.
LONGEST_TEXT_BYTES = 64 << 20
#: Deepest nesting of tables and lists; the formats of this project need six.
DEEPEST_NESTING = 32
#: Largest integer; floating point has none beyond 1e308, and no count or address of these formats comes near this.
LARGEST_INTEGER = 10**30


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the content of a text file, without a byte order mark.

    Parameters
    ----------
    path : path
        File in UTF-8, or in UTF-16 with its byte order mark.

    Returns
    -------
    str
        With every line end as a line feed.

    Raises
    ------
    InputError
        No such file, longer than 64 MiB, or in another encoding; names the first line that shows it.
    """
    where = str(check_path(path))
    try:
        with open(path, "rb") as file:
            content = file.read(LONGEST_TEXT_BYTES + 1)
    except (OSError, ValueError) as error:  # a ValueError: a name with a NUL in it
        raise InputError(f"cannot be read ({reason(error)})", where=where, remedy="check the path") from None
    if len(content) > LONGEST_TEXT_BYTES:
        raise InputError(
            f"longer than {LONGEST_TEXT_BYTES >> 20} MiB", where=where, remedy="give a settings, model or result file"
        )
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        line, byte = content.count(b"\n", 0, error.start) + 1, content[error.start : error.start + 1]
        raise InputError(
            f"line {line} is not UTF-8 (byte 0x{byte.hex().upper()}, in cp1252 {byte.decode('cp1252', 'replace')!r})",
            where=where,
            remedy="save the file as UTF-8",
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def check_path(path: Any) -> Path:
    """Return a path that a file can have.

    Raises
    ------
    InputError
        No text or path, or a name with a NUL or half of a character in it.
    """
    try:
        name = os.fsencode(path)
    except (TypeError, UnicodeError):
        raise InputError("cannot be read (no path)", where=f"{path!r}"[:200], remedy="give a file's path") from None
    if b"\0" in name:
        raise InputError("cannot be read (a NUL in its name)", where=f"{path!r}"[:200], remedy="check the path")
    return Path(os.fsdecode(name))


def reason(error: Exception) -> str:
    """Return what the operating system says of a failed access to a file, without the path."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises
    ------
    InputError
        As :func:`read_text`; not TOML, nested too deep, or a name or text with a control character.
    """
    content: dict[str, Any] = _parse(path, tomllib.loads, "TOML")
    return content


def read_json(path: str | os.PathLike[str]) -> Any:
    """Return the content of a JSON file; NaN and Infinity, which JSON does not have, are refused.

    Raises
    ------
    InputError
        As :func:`read_text`; not JSON, nested too deep, or a name or text with a control character.
    """
    return _parse(path, lambda text: json.loads(text, parse_constant=_no_number), "JSON")


def _no_number(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number of JSON")


def _parse(path: str | os.PathLike[str], parse: Callable[[str], Any], kind: str) -> Any:
    text = read_text(path)
    try:
        content = parse(text)
        _require_plain(content, 0)
    except RecursionError:
        raise InputError(
            f"tables or lists are nested deeper than {DEEPEST_NESTING}", where=str(path), remedy="write it flat"
        ) from None
    except ValueError as error:
        line, remedy = _line_of(error, text)
        raise InputError(f"not {kind}: {_short(error)}{line}", where=str(path), remedy=remedy) from None
    return content


def _line_of(error: ValueError, text: str) -> tuple[str, str]:
    """Return the line that a parser names, to be shown, and what is wrong with it where that is usual."""
    at, lines = re.search(r"\bat line (\d+), column", str(error)), text.split("\n")
    if at is None or int(at[1]) > len(lines):
        return "", "correct the line"
    line = lines[int(at[1]) - 1].split("#")[0].strip()
    shown = f": {printable(line[:80])}"
    value = line.partition("=")[2].strip()
    if re.fullmatch(r"[-+]?\d+,\d+", value):
        return shown, "write the decimal mark as a point"
    if value.count('"') % 2:
        return shown, "close the quotes"
    return shown, "put texts in quotes" if re.match(r"[^\W\d]", value) else "correct the line"


def _short(error: ValueError) -> str:
    return printable(str(error).splitlines()[0][:200]) if str(error) else type(error).__name__


def _require_plain(content: Any, depth: int) -> None:
    """Refuse what is nested too deep, and text by which a file could command a terminal."""
    if depth > DEEPEST_NESTING:
        raise RecursionError
    if isinstance(content, str) and (found := next(filter(is_control, content), None)) is not None:
        raise ValueError(f"the text {printable(content[:40])!r} holds the control character U+{ord(found):04X}")
    if isinstance(content, int) and abs(content) > LARGEST_INTEGER:
        raise ValueError(f"an integer of {len(str(abs(content)))} digits is beyond what arithmetic holds")
    if isinstance(content, dict):
        for key, value in content.items():
            _require_plain(key, depth)
            _require_plain(value, depth + 1)
    elif isinstance(content, list):
        for value in content:
            _require_plain(value, depth + 1)


def is_control(character: str) -> bool:
    """Return whether a character commands a terminal or hides text; line ends and tabs do not."""
    return unicodedata.category(character) in ("Cc", "Cf", "Cs") and character not in "\n\t\u00ad\u200b\u200c\u200d"


def escape_controls(text: str) -> str:
    """Return a text with what commands a terminal, hides text or turns its direction written out; lines stay."""
    return "".join(c.encode("unicode_escape").decode() if is_control(c) else c for c in text)


def printable(text: str) -> str:
    """Return a text with its control characters written out, line ends and tabs included."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == " " else c.encode("unicode_escape").decode() for c in text)
