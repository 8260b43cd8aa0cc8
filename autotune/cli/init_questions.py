"""Questions of ``autotune init``: an answer from its flag, or asked at a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection
from typing import Any

import typer

from autotune.errors import InputError


class Questions:
    """Take an answer from its flag, else ask; away from a terminal collect what is missing."""

    def __init__(self) -> None:
        self._missing: list[str] = []
        self._asks = sys.stdin.isatty() and sys.stdout.isatty()

    def ask(
        self,
        flag: str,
        given: Any,
        question: str,
        convert: Callable[[str], Any],
        default: str | None = None,
        suggested: str | None = None,
    ) -> Any:
        """Return what is given, or the answer; without a terminal the default, else it is missing.

        Parameters
        ----------
        flag : str
            Option that gives the answer.
        given : object
            What the option said; None where it was not used.
        question : str
            What is asked.
        convert : callable
            From an answer's text to what it means; an answer that it refuses is asked for again.
        default : str, optional
            Answer where nothing is entered.
        suggested : str, optional
            Answer where a person presses Enter; away from a terminal nobody has seen it, and the answer is missing.
        """
        if given is not None:
            return convert(given) if isinstance(given, str) else given
        if not self._asks:
            if default is None:
                self._missing.append(flag)
            return default
        offered = default if suggested is None else suggested
        check = _ask_again_where_refused(convert, is_needed=offered is None)
        return typer.prompt(question, default=offered or "", show_default=bool(offered), value_proc=check)

    def require(self) -> None:
        """Refuse where an answer is missing.

        Raises
        ------
        InputError
            Names every flag that is missing.
        """
        if self._missing:
            flags = ", ".join(self._missing)
            raise InputError(f"{flags}: no answer", where="autotune init", remedy="give them, or call it at a terminal")


def _ask_again_where_refused(convert: Callable[[str], Any], *, is_needed: bool) -> Callable[[str], Any]:
    """Let a question be asked again where its answer is refused, or missing and needed."""

    def check(answer: str) -> Any:
        if is_needed and not answer.strip():
            raise typer.BadParameter("an answer is needed; Ctrl-C leaves, and nothing is written")
        try:
            return convert(answer)
        except ValueError as error:
            raise typer.BadParameter(error.what if isinstance(error, InputError) else str(error)) from None

    return check


def one_of(answer: str, known: Collection[str], flag: str) -> str:
    """Return an answer that is one of the known ones; refuse any other.

    Parameters
    ----------
    answer : str
        What was given.
    known : collection of str
        What may be.
    flag : str
        Its option, for the refusal.

    Raises
    ------
    InputError
        Any other answer.
    """
    if answer not in known:
        raise InputError(f"{answer!r} is none of {', '.join(known)}", where=flag)
    return answer


def pair(answer: str) -> tuple[float, float]:
    """Return the two numbers of an answer: 0 100 or 0,100; between blanks or semicolons with decimal commas too."""
    parts = answer.replace(",", " ").split()
    if len(parts) != 2:
        parts = answer.replace(";", " ").split()
    if len(parts) != 2:
        raise InputError(f"{answer!r}: two numbers are wanted, such as 0 100", where="autotune init")
    return number(parts[0]), number(parts[1])


def limits(answer: str) -> tuple[float, float]:
    """Return the two numbers of an answer, the lower one first."""
    low, high = pair(answer)
    if not low < high:
        raise InputError(f"{answer!r}: the lowest is to be below the highest, such as 0 100", where="autotune init")
    return low, high


def number(answer: str) -> float:
    """Return the number of an answer; a decimal comma is taken for a point, and it is said that it was."""
    text = answer.strip()
    with_point = text.replace(",", ".") if text.count(",") == 1 and "." not in text else text
    try:
        value = float(with_point)
    except ValueError:
        raise InputError(f"{answer!r} is no number, such as 0.1", where="autotune init") from None
    if with_point != text:
        typer.echo(f"{text} is read as {value:g}")
    return value


def number_of_option(answer: str) -> float:
    """Return the number of an option; refused as any other option is."""
    try:
        return number(answer)
    except InputError as error:
        raise typer.BadParameter(error.what) from None


def number_within(limits: tuple[float, float] | None) -> Callable[[str], float]:
    """Return what reads a number between two limits; any number where they are missing.

    Parameters
    ----------
    limits : (float, float) or None
        The lowest and the highest that is taken.
    """

    def read(answer: str) -> float:
        value = number(answer)
        if limits is not None and not limits[0] <= value <= limits[1]:
            raise InputError(f"{value:g} is not within {limits[0]:g} to {limits[1]:g}", where="autotune init")
        return value

    return read


def middle(limits: tuple[float, float] | None) -> str | None:
    """Return the middle of two limits as it would be answered; nothing where they are missing."""
    return None if limits is None else f"{sum(limits) / 2.0:g}"
