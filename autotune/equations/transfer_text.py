"""Transfer functions as people write them: ``-65.5/(s(0.36s+1)) e^-0.1s``, poles and zeros, gain and time constants.

Between factors the sign of multiplication may be missing, as on paper; a dead time is written ``e^-0.1s``,
``e^(-0.1s)`` or ``exp(-0.1 s)``. Also ``zpk(zeros; poles; gain)`` with lists in brackets and ``K=2 T=0.3,0.1 L=0.05``.
"""

from __future__ import annotations

import re
from typing import Any, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import InputError
from autotune.models import TransferFunction

_HELP = "write it as -65.5/(s(0.36s+1)) e^-0.1s, zpk([-1]; [-2, -3]; 4) or K=2 T=0.3,0.1 L=0.05"
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_DELAY = re.compile(
    rf"(?:\*|·)?\s*(?:e\s*\^\s*|exp\s*)(?:\(\s*-\s*({_NUMBER})?\s*\*?\s*s\s*\)|-\s*({_NUMBER})?\s*\*?\s*s|"
    rf"\{{\s*-\s*({_NUMBER})?\s*\*?\s*s\s*\}})"
)
_TOKEN = re.compile(rf"\s*(?:({_NUMBER})|([sp])|([-+*/^()]))")
_Pair: TypeAlias = tuple[Any, Any]  # polynomials above and below, descending powers
#: Longest text, deepest nesting and highest power that are read.
_LONGEST, _DEEPEST, _HIGHEST = 2000, 40, 20


def parse_transfer_function(text: str) -> TransferFunction:
    """Read a transfer function.

    Parameters
    ----------
    text : str
        Rational in s with an optional dead time, ``zpk(...)``, or gain and time constants.

    Returns
    -------
    TransferFunction
        With its dead time.

    Raises
    ------
    InputError
        What cannot be read, or is not proper.

    Examples
    --------
    >>> parse_transfer_function("-65.5/(s(0.36s+1)) e^-0.1s")
    TransferFunction(num=(-65.5,), den=(0.36, 1.0, 0.0), delay_s=0.1)
    """
    if not isinstance(text, str):
        raise _refused(f"{text!r}"[:40], "a transfer function is written as text")
    if len(text) > _LONGEST:
        raise _refused(text[:40], f"{len(text)} characters")
    plain = text.strip().replace("−", "-").replace("·", "*").replace("**", "^")
    if plain.lower().startswith("zpk"):
        found = _zpk(plain)
    elif re.match(r"^K\s*=", plain):
        found = _gain_and_lags(plain)
    else:
        delays = [float(next((g for g in m.groups() if g), "1")) for m in _DELAY.finditer(plain)]
        num, den = _Rational(_DELAY.sub(" ", plain), text).whole()
        found = _made(num, den, sum(delays), text)
    if not found.is_proper:
        raise _refused(text, "the numerator has a higher degree than the denominator")
    return found


def _refused(text: str, what: str) -> InputError:
    return InputError(what, where=f"transfer function {text!r}", remedy=_HELP)


def _made(num: FloatArray, den: FloatArray, delay: float, text: str) -> TransferFunction:
    try:
        return TransferFunction(num=tuple(map(float, num)), den=tuple(map(float, den)), delay_s=delay)
    except InputError as error:
        raise _refused(text, error.what) from None


def _zpk(text: str) -> TransferFunction:
    inner = re.fullmatch(r"(?i)zpk\s*\(\s*\[(.*?)\]\s*[;,]\s*\[(.*?)\]\s*[;,]\s*(.+?)\s*\)(?:\s*(.*))?", text)
    if not inner:
        raise _refused(text, "zeros, poles and gain are not told apart")
    try:
        zeros, poles = ([complex(p.replace("i", "j").replace(" ", "")) for p in _parts(g)] for g in inner.groups()[:2])
        gain = float(inner[3])
    except ValueError:
        raise _refused(text, "a zero, a pole or the gain is no number") from None
    num, den = gain * np.atleast_1d(np.poly(zeros)), np.atleast_1d(np.poly(poles))
    if np.any(np.abs(np.imag(num)) > 1e-9) or np.any(np.abs(np.imag(den)) > 1e-9):
        raise _refused(text, "complex zeros and poles come in pairs")
    late = _DELAY.search(inner[4] or "")
    delay = float(next((g for g in late.groups() if g), "1")) if late else 0.0
    return _made(np.real(num), np.real(den), delay, text)


def _parts(text: str) -> list[str]:
    return [part for part in re.split(r"\s*[,;]\s*", text.strip()) if part]


def _gain_and_lags(text: str) -> TransferFunction:
    given = dict(re.findall(r"([KTLI])\s*=\s*([^=]+?)(?=\s+[KTLI]\s*=|$)", text))
    try:
        gain = float(given["K"])
        lags = [float(part) for part in _parts(given.get("T", "").replace(" ", ","))]
        delay, integrators = float(given.get("L", "0")), int(given.get("I", "0"))
    except ValueError:
        raise _refused(text, "K, T, L or I is no number") from None
    den: Any = np.array([1.0])
    for lag in lags:
        den = np.polymul(den, [lag, 1.0])
    return _made(np.array([gain]), np.append(den, np.zeros(min(integrators, _HIGHEST))), delay, text)


class _Rational:
    """A rational function of s: one pass over its tokens, each value a pair of polynomials."""

    def __init__(self, plain: str, text: str) -> None:
        self._text = text
        self._tokens: list[str] = []
        at = 0
        while plain[at:].strip():
            found = _TOKEN.match(plain, at)
            if not found:
                raise _refused(text, f"{plain[at:].strip()[0]!r} has no meaning here")
            self._tokens.append(found[0].strip())
            at = found.end()
        self._at = self._depth = 0

    def whole(self) -> _Pair:
        if not self._tokens:
            raise _refused(self._text, "nothing is written")
        value = self._sum()
        if self._at < len(self._tokens):
            raise _refused(self._text, f"{self._tokens[self._at]!r} is one too many")
        return value

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _sum(self) -> _Pair:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise _refused(self._text, "nested too deep")
        sign = 1.0
        while self._peek() in ("+", "-"):
            sign *= -1.0 if self._peek() == "-" else 1.0
            self._at += 1
        num, den = self._product()
        num = sign * num
        while self._peek() in ("+", "-"):
            sign = 1.0 if self._peek() == "+" else -1.0
            self._at += 1
            other_num, other_den = self._product()
            num = np.polyadd(np.polymul(num, other_den), sign * np.polymul(other_num, den))
            den = np.polymul(den, other_den)
        self._depth -= 1
        return num, den

    def _product(self) -> _Pair:
        num, den = self._power()
        divides = False
        while (token := self._peek()) and token not in "+-)":
            if divides and token not in "*/":
                raise _refused(self._text, f"what stands behind the / before {token!r} is not clear: write brackets")
            divides = token == "/"
            if token in "*/":
                self._at += 1
                negative = self._peek() == "-"
                self._at += self._peek() in ("+", "-") and self._peek() != ""
            else:
                negative = False  # the sign of multiplication is missing, as on paper
            other_num, other_den = self._power()
            if divides:
                other_num, other_den = other_den, other_num
            num = np.polymul(num, other_num) * (-1.0 if negative else 1.0)
            den = np.polymul(den, other_den)
        return num, den

    def _power(self) -> _Pair:
        num, den = self._atom()
        if self._peek() == "^":
            self._at += 1
            exponent = self._peek()
            if not re.fullmatch(r"\d+", exponent) or int(exponent) > _HIGHEST:
                raise _refused(self._text, f"{exponent!r} is no whole power")
            self._at += 1
            base = num, den
            num, den = np.ones(1), np.ones(1)
            for _ in range(int(exponent)):
                num, den = np.polymul(num, base[0]), np.polymul(den, base[1])
        return num, den

    def _atom(self) -> _Pair:
        token = self._peek()
        self._at += 1
        if token in ("s", "p"):
            return np.array([1.0, 0.0]), np.array([1.0])
        if token == "(":
            value = self._sum()
            if self._peek() != ")":
                raise _refused(self._text, "')' is missing")
            self._at += 1
            return value
        try:
            return np.array([float(token)]), np.array([1.0])
        except ValueError:
            raise _refused(
                self._text, f"{token!r} has nothing before it" if token else "something is missing"
            ) from None
