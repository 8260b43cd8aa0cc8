"""Which column is the time, the command, the measurement, the set-point: by name, and by how the values behave."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np

from autotune.arrays import FloatArray
from autotune.files.cells import numbers
from autotune.files.header import words as vocabulary
from autotune.files.stamps import StampForm, detect_form, is_milliseconds
from autotune.files.table import Table
from autotune.files.tags import follower, instrument

_TIME = vocabulary(
    "t time zeit timestamp datetime date datum uhrzeit zeitstempel stamp timestring zeitpunkt datenum elapsed temps"
    " horodatage fecha tempo tijd clock"
)


def _weigh_terms(terms: str, usual: str, often: str) -> dict[str, int]:
    """Return what a word says of a signal: 3 the term of the field, 2 a usual name, 1 a quantity that it often is."""
    return {word: value for value, words in ((1, often), (2, usual), (3, terms)) for word in words.split()}


_WORDS: Mapping[str, Mapping[str, int]] = {
    "u": _weigh_terms(
        "u uk op command cmd controlleroutput stellgroesse stellgrosse stellwert stellgrad",
        "stellsignal stell manipulated mv lmn co cv out out1 input eingang actuator commande ctrl control drive demand"
        " controllerout controlsignal",
        "valve ventil pwm heater heizung heat power leistung pump pumpe duty voltage spannung fan motor current torque"
        " throttle dac output",
    ),
    "y": _weigh_terms(
        "y yk pv processvalue processvariable istwert regelgroesse regelgrosse mesure sensor",
        "measurement measured meas messwert actual act ist output ausgang feedback response mess",
        "temperature temperatur temp level fuellstand fullstand flow durchfluss pressure druck speed drehzahl position"
        " pos height angle winkel velocity concentration ph humidity feuchte niveau thermocouple encoder rpm adc",
    ),
    "r": _weigh_terms(
        "r rk sp setpoint sollwert reference consigne fuehrungsgroesse fuhrungsgrosse",
        "soll ref target setp setvalue sv w desired",
        "",
    ),
}
#: what a PLC's programmer writes before a name for its type: rActualValue is a REAL, not a set-point r
_TYPE_PREFIX = re.compile(r"(?<![A-Za-z])(?:l?r|u?[dsl]?int|u?[dsl]?i|f|b|x|d?w|n)(?=[A-Z][a-z])")
_USUAL = _WEAKEST_SURE = 2
_STEM_BONUS = 2.0


@dataclass(frozen=True, kw_only=True)
class SignalNames:
    """Columns of a file, by what they are; empty where it is not said.

    Attributes
    ----------
    t, u, y, r : str
        Time, command, measurement, set-point.
    """

    t: str = ""
    u: str = ""
    y: str = ""
    r: str = ""


@dataclass(frozen=True, kw_only=True)
class Roles:
    """What was made of a table's columns.

    Attributes
    ----------
    time : tuple of str
        Columns of the stamp: one, or date, time of day and milliseconds, in this order.
    names : SignalNames
        The columns; where one was not found out, the best guess or "".
    unsure : tuple of str
        Of t, u and y, those that somebody should confirm.
    others : tuple of str
        Further columns of numbers.
    """

    time: tuple[str, ...]
    names: SignalNames
    unsure: tuple[str, ...]
    others: tuple[str, ...]


def find_roles(table: Table, given: SignalNames) -> Roles:
    """Find out which column is what.

    Parameters
    ----------
    table : Table
        The file.
    given : SignalNames
        What is said already.

    Raises
    ------
    InputError
        A column that is given is not there.
    """
    named = {role: table.name_of(name) for role, name in vars(given).items() if name}
    time, sure_time = ((named["t"],), True) if "t" in named else _time(table, set(named.values()))
    numeric = [name for name in table.names if name not in time and _is_numeric(table, name)]
    free = [name for name in numeric if name not in named.values()]
    unsure = [] if sure_time else ["t"]
    points = {role: {name: _points(table, name, role) for name in free} for role in _WORDS}
    r = named.get("r") or _only_best(points["r"], least=2)
    pairs = _pairs(table, named, [name for name in free if name != r], points)
    if pairs:
        (best, u, y), rest = pairs[0], pairs[1:]
        tie = [pair for pair in rest if pair[0] > best - 0.5]
        weak = [role for role, name in (("u", u), ("y", y)) if role not in named and not _stands(points, role, name)]
        if len(weak) == 1 and len([name for name in free if name != r]) == 1 + ("u" not in named) - ("u" in named):
            weak = []  # the other is known and no further column is left
        if either := _either_way(table, numeric, named, r):
            u, y, sure = either
            weak = [] if sure else ["u", "y"]
        unsure += [role for role, name in (("u", u), ("y", y)) if role not in named and (tie or role in weak)]
    else:
        u, y = named.get("u", ""), named.get("y", "")
        unsure += [role for role, name in (("u", u), ("y", y)) if not name]
    r = r or _same_loop(points["r"], u, y)
    names = SignalNames(t=time[0] if time else "", u=u, y=y, r=r)
    taken = {*time, u, y, r}
    return Roles(time=time, names=names, unsure=tuple(unsure), others=tuple(n for n in numeric if n not in taken))


def _either_way(table: Table, numeric: Sequence[str], named: Mapping[str, str], r: str) -> tuple[str, str, bool] | None:
    """Return command and measurement where their names are used both ways round, and whether the values decide.

    y for the command and x for what is controlled is the notation of DIN 19226 and IEC 60050-351 with w for the
    set-point; elsewhere y is the measurement. In and out are ports of the plant or of the controller. The one that
    keeps to the set-point is the measurement; where none does, or there is no set-point, DIN's and the plant's are
    proposed. Input and output without a set-point are the plant's.
    """
    letters = {table.bare(name).lower(): name for name in numeric}
    if {"u", "y"} & set(named) or "u" in letters:
        return None
    pairs = [("y", "x"), ("in", "out"), ("in1", "out1")]
    pair = next((names for names in [*pairs, *[("input", "output")] * bool(r)] if {*names} <= set(letters)), None)
    if pair is None:
        return None
    u, y = (letters[name] for name in pair)
    nearer = (
        None if r in ("", u, y) else follower(*(numbers(table.sample[name], table.decimal)[0] for name in (r, u, y)))
    )
    return (y, u, True) if nearer == 0 else (u, y, nearer == 1)


def _time(table: Table, taken: set[str]) -> tuple[tuple[str, ...], bool]:
    """Return the columns of the stamp and whether only one choice fits."""
    free = [name for name in table.names if name not in taken]
    named = [name for name in free if _words(name, table) & _TIME and _form(table, name) is not None]
    stamps = [name for name in free if (form := _form(table, name)) is not None and form.pattern is not None]
    stamps += [name for name in free if name in table.in_seconds]
    first = next(iter(stamps or named), None)
    if first is None:
        rising = [name for name in free[:1] if _rises(table, name)]
        return tuple(rising), bool(rising) and not _counts(table, rising[0])
    form = _form(table, first)
    time = [first]
    if (form is not None and form.pattern is not None and "H" not in form.pattern.groupindex) or _has_no_clock(
        table, first
    ):
        time += [name for name in stamps if name != first and _text_form(table, name) == "time of day"][:1]
    time += [name for name in free if name not in time and is_milliseconds(table.sample[name], name, table.decimal)][:1]
    return tuple(time), True


def _has_no_clock(table: Table, name: str) -> bool:
    cells = table.sample[name]
    return (
        not isinstance(cells, np.ndarray) and not any(":" in cell for cell in cells) and _text_form(table, name) != ""
    )


def _text_form(table: Table, name: str) -> str:
    form = _form(table, name)
    return "" if form is None or form.pattern is None else form.text


def _form(table: Table, name: str) -> StampForm | None:
    return detect_form(table.sample[name], name, table.units.get(name, ""), table.decimal)


def _rises(table: Table, name: str) -> bool:
    values, _ = numbers(table.sample[name], table.decimal)
    return bool(values.size > 2 and np.all(np.diff(values) > 0))


def _counts(table: Table, name: str) -> bool:
    """Return whether a column only numbers its rows."""
    values, _ = numbers(table.sample[name], table.decimal)
    return bool(np.median(np.diff(values)) == 1.0)


def _is_numeric(table: Table, name: str) -> bool:
    values, empty = numbers(table.sample[name], table.decimal)
    return bool(np.isfinite(values).sum() > 0.5 * (~empty).sum() and np.isfinite(values).any())


def _words(name: str, table: Table) -> set[str]:
    """Return the words of a column's name, and of what else the header says of it, in plain small letters."""
    found: set[str] = set()
    for text in {table.bare(name), table.labels.get(name, "")}:
        text = _TYPE_PREFIX.sub("", text)
        plain = unicodedata.normalize("NFKD", text.replace("ß", "ss")).encode("ascii", "ignore").decode()
        german = text.lower().replace("ä", "ae").replace("ö", "oe").replace("ü", "ue").replace("ß", "ss")
        parted = re.sub(r"([a-z])([A-Z])", r"\1 \2", plain)
        for variant in (plain.lower(), german, parted.lower()):
            words = re.findall(r"[a-z]+", variant)
            found |= {*words, *("".join(pair) for pair in pairwise(words))}
        found |= set(re.findall(r"[a-z]+", plain.lower().replace("_", "").replace(" ", "")))
    return found


def _points(table: Table, name: str, role: str) -> float:
    words = _words(name, table)
    tag = _USUAL * (instrument(table.bare(name)) == role)
    best = max((value for word, value in _WORDS[role].items() if word in words), default=0)
    if any(word in words for known in _WORDS.values() for word in known):
        return float(max(best, tag))  # in "inflow valve" the valve is what is said, and not the flow
    compound = max(
        (value for word, value in _WORDS[role].items() for own in words if len(word) > 3 and own.endswith(word)),
        default=0,
    )
    return float(max(compound, tag))


def _only_best(points: Mapping[str, float], least: float) -> str:
    """Return the name with the most points where no other has as many."""
    ranked = sorted(points, key=lambda name: -points[name])
    if not ranked or points[ranked[0]] < least or (len(ranked) > 1 and points[ranked[1]] == points[ranked[0]]):
        return ""
    return ranked[0]


def _pairs(
    table: Table, named: Mapping[str, str], free: Sequence[str], points: Mapping[str, Mapping[str, float]]
) -> list[tuple[float, str, str]]:
    """Return the pairs of command and measurement with their points, the best first."""
    commands = [named["u"]] if "u" in named else free
    measured = [named["y"]] if "y" in named else free
    behaves = {name: _held_share(table, name) for name in {*commands, *measured}}
    pairs = []
    for u, y in product(commands, measured):
        if u == y:
            continue
        found = points["u"].get(u, 0.0) - max(points["y"].get(u, 0.0), points["r"].get(u, 0.0))
        found += points["y"].get(y, 0.0) - max(points["u"].get(y, 0.0), points["r"].get(y, 0.0))
        found += _STEM_BONUS * (_stem(u) == _stem(y) != "")
        found += 0.2 * (behaves[u] - behaves[y])  # orders equals, which stay unsure
        pairs.append((found, u, y))
    return sorted(pairs, key=lambda pair: -pair[0])[:50]


def _stands(points: Mapping[str, Mapping[str, float]], role: str, name: str) -> bool:
    """Return whether a column's name says its role: by the field's term, or as the only one with a usual name."""
    others = [other for other in ("u", "y", "r") if other != role]
    own = points[role].get(name, 0.0)
    if own <= max(points[other].get(name, 0.0) for other in others):
        return False
    return own >= _WEAKEST_SURE or sum(value > 0 for value in points[role].values()) == 1


def _stem(name: str) -> str:
    """Return what a tag has in common with the other tags of its loop: TIC101 of TIC101.PV."""
    parts = re.split(r"[.\-_/:\\ ]+(?=[^.\-_/:\\ ]+$)", name.strip())
    return parts[0] if len(parts) == 2 else ""


def _same_loop(points: Mapping[str, float], u: str, y: str) -> str:
    """Return the set-point among several that has the stem of the loop's other tags."""
    stems = {_stem(u), _stem(y)} - {""}
    found = [name for name, value in points.items() if value >= 2 and _stem(name) in stems and name not in (u, y)]
    return found[0] if len(found) == 1 else ""


def _held_share(table: Table, name: str) -> float:
    """Return the share of rows in which a signal stays as it was: near 1 for a command in steps."""
    values: FloatArray = numbers(table.sample[name], table.decimal)[0]
    known = values[np.isfinite(values)]
    return float(np.mean(np.diff(known) == 0.0)) if known.size > 1 else 0.0


def confirm_roles(roles: Roles, answers: Mapping[str, str]) -> Roles:
    """Return the roles with what somebody answered.

    Parameters
    ----------
    roles : Roles
        As they were found out.
    answers : mapping of str to str
        Columns by signal: t, u, y or r.
    """
    names = replace(roles.names, **dict(answers))
    time = (answers["t"],) if "t" in answers else roles.time
    taken = {*time, names.u, names.y, names.r}
    return Roles(time=time, names=names, unsure=(), others=tuple(n for n in roles.others if n not in taken))
