"""Transfer functions as people write them: ``-65.5/(s(0.36s+1)) e^-0.1s``, poles and zeros, gain and time constants.

Between factors the sign of multiplication may be missing, as on paper; a dead time is written ``e^-0.1s``,
``e^(-0.1s)`` or ``exp(-0.1 s)``. Also ``zpk(zeros; poles; gain)`` with lists in brackets and ``K=2 T=0.3,0.1 L=0.05``.
"""

from __future__ import annotations

import re
from typing import Any, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.expressions import Call, Expression, Name, Number, parse, to_text
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
#: Longest text and highest power that are read.
_LONGEST, _HIGHEST = 2000, 20


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
        raise _refusal(f"{text!r}"[:40], "a transfer function is written as text")
    if len(text) > _LONGEST:
        raise _refusal(text[:40], f"{len(text)} characters")
    plain = text.strip().replace("−", "-").replace("·", "*").replace("**", "^")
    if plain.lower().startswith("zpk"):
        found = _zpk(plain)
    elif re.match(r"^K\s*=", plain):
        found = _gain_and_lags(plain)
    else:
        delays = [float(next((g for g in m.groups() if g), "1")) for m in _DELAY.finditer(plain)]
        num, den = _rational(_DELAY.sub(" ", plain), text)
        found = _make_transfer_function(num, den, sum(delays), text)
    if not found.is_proper:
        raise _refusal(text, "the numerator has a higher degree than the denominator")
    return found


def _refusal(text: str, what: str) -> InputError:
    return InputError(what, where=f"transfer function {text!r}", remedy=_HELP)


def _make_transfer_function(num: FloatArray, den: FloatArray, delay: float, text: str) -> TransferFunction:
    try:
        return TransferFunction(num=tuple(map(float, num)), den=tuple(map(float, den)), delay_s=delay)
    except InputError as error:
        raise _refusal(text, error.what) from None


def _zpk(text: str) -> TransferFunction:
    inner = re.fullmatch(r"(?i)zpk\s*\(\s*\[(.*?)\]\s*[;,]\s*\[(.*?)\]\s*[;,]\s*(.+?)\s*\)(?:\s*(.*))?", text)
    if not inner:
        raise _refusal(text, "zeros, poles and gain are not told apart")
    try:
        zeros, poles = ([complex(p.replace("i", "j").replace(" ", "")) for p in _parts(g)] for g in inner.groups()[:2])
        gain = float(inner[3])
    except ValueError:
        raise _refusal(text, "a zero, a pole or the gain is no number") from None
    num, den = gain * np.atleast_1d(np.poly(zeros)), np.atleast_1d(np.poly(poles))
    if np.any(np.abs(np.imag(num)) > 1e-9) or np.any(np.abs(np.imag(den)) > 1e-9):
        raise _refusal(text, "complex zeros and poles come in pairs")
    late = _DELAY.search(inner[4] or "")
    delay = float(next((g for g in late.groups() if g), "1")) if late else 0.0
    return _make_transfer_function(np.real(num), np.real(den), delay, text)


def _parts(text: str) -> list[str]:
    return [part for part in re.split(r"\s*[,;]\s*", text.strip()) if part]


def _gain_and_lags(text: str) -> TransferFunction:
    given = dict(re.findall(r"([KTLI])\s*=\s*([^=]+?)(?=\s+[KTLI]\s*=|$)", text))
    try:
        gain = float(given["K"])
        lags = [float(part) for part in _parts(given.get("T", "").replace(" ", ","))]
        delay, integrators = float(given.get("L", "0")), int(given.get("I", "0"))
    except ValueError:
        raise _refusal(text, "K, T, L or I is no number") from None
    den: Any = np.array([1.0])
    for lag in lags:
        den = np.polymul(den, [lag, 1.0])
    return _make_transfer_function(np.array([gain]), np.append(den, np.zeros(min(integrators, _HIGHEST))), delay, text)


def _with_products(plain: str, text: str) -> str:
    """Return a text with the signs of multiplication that are missing in it, as on paper."""
    written, at, before, divides = "", 0, "", [False]
    while plain[at:].strip():
        found = _TOKEN.match(plain, at)
        if not found:
            raise _refusal(text, f"{plain[at:].strip()[0]!r} has no meaning here")
        token, at = found[0].strip(), found.end()
        if before[-1:].isdigit() and token[0] in ".0123456789":
            raise _refusal(text, f"no sign stands between the numbers {before} and {token}")
        if before not in ("", *"-+*/^(") and token not in "-+*/^)":
            if divides[-1]:
                raise _refusal(text, f"what stands behind the / before {token!r} is not clear: write brackets")
            written += "*"
        if token in "-+*/" and before not in ("*", "/"):
            divides[-1] = token == "/"
        elif token == "(":
            divides.append(False)
        elif token == ")" and len(divides) > 1:
            divides.pop()
        written, before = f"{written} {token}", token
    return written


def _rational(plain: str, text: str) -> _Pair:
    """Return numerator and denominator of a rational function of s."""
    try:
        return _fold(parse(_with_products(plain, text)))
    except InputError as error:
        raise _refusal(text, error.what) from None


def _fold(tree: Expression) -> _Pair:
    """Return the polynomials that an expression in s is the ratio of."""
    match tree:
        case Number(value):
            return np.array([value]), np.ones(1)
        case Name():
            return np.array([1.0, 0.0]), np.ones(1)
        case Call("neg", (inner,)):
            num, den = _fold(inner)
            return -num, den
        case Call("^", (base, Number(power))) if power == int(power) <= _HIGHEST:
            num, den = np.ones(1), np.ones(1)
            above, below = _fold(base)
            for _ in range(int(power)):
                num, den = np.polymul(num, above), np.polymul(den, below)
            return num, den
        case Call("/", (left, Call("neg", (right,)))):
            return _fold(Call("neg", (Call("/", (left, right)),)))
        case Call(sign, (left, right)) if sign != "^":
            (a, b), (c, d) = _fold(left), _fold(right)
            if sign in "+-":
                c = c if sign == "+" else -c
                return np.polyadd(np.polymul(a, d), np.polymul(c, b)), np.polymul(b, d)
            c, d = (c, d) if sign == "*" else (d, c)
            return np.polymul(a, c), np.polymul(b, d)
    raise InputError(f"{to_text(tree)} has no whole power up to {_HIGHEST}", where="transfer function")
