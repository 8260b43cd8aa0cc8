"""Time stamps of any form as seconds: numbers with their unit, ISO 8601, dates of several countries, times of day."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import InputError
from autotune.files.cells import NUMBER, Cells, numbers

_DAY_S = 86400.0
_EPOCH = datetime.date(1970, 1, 1).toordinal()
#: Months by the first three letters of their name, in English, German and French.
_MONTHS = {
    **dict.fromkeys(("jan",), 1), **dict.fromkeys(("feb", "fév"), 2), **dict.fromkeys(("mar", "mär", "mrz"), 3),
    **dict.fromkeys(("apr", "avr"), 4), **dict.fromkeys(("may", "mai"), 5), **dict.fromkeys(("jun",), 6),
    **dict.fromkeys(("jul",), 7), **dict.fromkeys(("aug", "aoû"), 8), **dict.fromkeys(("sep",), 9),
    **dict.fromkeys(("oct", "okt"), 10), **dict.fromkeys(("nov",), 11), **dict.fromkeys(("dec", "dez", "déc"), 12),
}  # fmt: skip
_TIME = r"(?P<H>\d{1,2}):(?P<M>\d{2})(?::(?P<S>\d{2})(?:[.,:](?P<f>\d{1,9}))?)?(?:\s*(?P<p>[AaPp])\.?[Mm]\.?)?"
_ZONE = r"\s*(?P<z>Z|UTC|GMT|[+-]\d{2}:?\d{2})?"
_GAP = r"(?:[T ,;]+|$)"
_ORDERS = {
    "year-month-day": r"(?P<Y>\d{4})[-/.](?P<m>\d{1,2})[-/.](?P<d>\d{1,2})",
    "year-month-day without marks": r"(?P<Y>\d{4})(?P<m>\d{2})(?P<d>\d{2})",
    "day.month.year": r"(?P<d>\d{1,2})[./-](?P<m>\d{1,2})[./-](?P<Y>\d{4}|\d{2})",
    "month/day/year": r"(?P<m>\d{1,2})[./-](?P<d>\d{1,2})[./-](?P<Y>\d{4}|\d{2})",
    "day-month-year, month by name": r"(?P<d>\d{1,2})[-. ]+(?P<b>[^\W\d]{3,9})\.?[-. ]+(?P<Y>\d{4}|\d{2})",
    "month day, year": r"(?P<b>[^\W\d]{3,9})\.? +(?P<d>\d{1,2}),? +(?P<Y>\d{4})",
}
_DIRECTIVES = {
    "d": r"(?P<d>\d{1,2})", "m": r"(?P<m>\d{1,2})", "Y": r"(?P<Y>\d{4})", "y": r"(?P<Y>\d{2})",
    "H": r"(?P<H>\d{1,2})", "I": r"(?P<H>\d{1,2})", "M": r"(?P<M>\d{1,2})", "S": r"(?P<S>\d{1,2})",
    "f": r"(?P<f>\d{1,9})", "p": r"(?P<p>[AaPp])[Mm]", "b": r"(?P<b>[^\W\d]+)", "B": r"(?P<b>[^\W\d]+)",
    "z": r"(?P<z>Z|[+-]\d{2}:?\d{2})", "%": "%",
}  # fmt: skip
#: Seconds in one unit of numeric stamps, by the unit's name.
UNITS_S = {
    "s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "sek": 1.0, "sekunden": 1.0, "sekunde": 1.0,
    "ms": 1e-3, "msec": 1e-3, "millis": 1e-3, "milliseconds": 1e-3, "millisekunden": 1e-3, "us": 1e-6, "µs": 1e-6,
    "μs": 1e-6, "microseconds": 1e-6, "ns": 1e-9, "min": 60.0, "mins": 60.0, "minute": 60.0, "minutes": 60.0,
    "minuten": 60.0, "h": 3600.0, "hr": 3600.0, "hour": 3600.0, "hours": 3600.0, "stunden": 3600.0, "std": 3600.0,
    "d": _DAY_S, "day": _DAY_S, "days": _DAY_S, "tage": _DAY_S,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class StampForm:
    """How stamps are written.

    Attributes
    ----------
    text : str
        In words, for a person.
    pattern : re.Pattern or None
        Of a date or a time of day; None for numbers.
    unit_s : float
        Seconds in one unit of numeric stamps.
    decimal : str
        Decimal mark of numeric stamps.
    sure : bool
        False where the cells allow another reading, such as day and month the other way round.
    """

    text: str
    pattern: re.Pattern[str] | None = None
    unit_s: float = 1.0
    decimal: str = "."
    sure: bool = True


def form_of_strptime(form: str) -> StampForm:
    """Return the form that a strptime format such as ``%d.%m.%Y %H:%M:%S,%f`` describes.

    Raises
    ------
    InputError
        A directive that is not known.
    """
    parts = re.split(r"(%.)", form)
    unknown = [part for part in parts if part.startswith("%") and part[1:] not in _DIRECTIVES]
    if unknown:
        known = " ".join(f"%{letter}" for letter in _DIRECTIVES)
        raise InputError(f"time format {form!r} has {unknown[0]}", where="time_format", remedy=f"known are {known}")
    pattern = "".join(_DIRECTIVES[part[1:]] if part.startswith("%") else re.escape(part) for part in parts)
    return StampForm(text=form, pattern=re.compile(pattern))


def detect_form(cells: Cells, name: str, unit: str = "", decimal: str = ".") -> StampForm | None:
    """Find out how a column of stamps is written.

    Parameters
    ----------
    cells : sequence of str, or (N,) array
        The column, or its beginning and end.
    name, unit : str
        The column's name, and its unit where the file says it.
    decimal : str
        The file's decimal mark.

    Returns
    -------
    StampForm or None
        None where the cells are no stamps.
    """
    if isinstance(cells, np.ndarray):
        return _numeric(cells, name, unit, ".")
    text = [cell.strip() for cell in cells if cell.strip()]
    if not text:
        return None
    values, _ = numbers(text, decimal)
    if np.isfinite(values).mean() > 0.9 and not _is_date_without_marks(text, name):
        return _numeric(values, name, unit, decimal)
    orders = sorted(_ORDERS, key=lambda order: order != "month/day/year") if _twelve_hours(text) else list(_ORDERS)
    for order in orders:
        date = _ORDERS[order]
        pattern = re.compile(rf"{date}(?:{_GAP}(?:{_TIME})?{_ZONE})?\s*")
        found = [_match(pattern, cell) for cell in text]
        if all(found):
            other = _other_way_round(text, order)
            return StampForm(text=order, pattern=pattern, sure=not other)
    time = re.compile(_TIME + r"\s*")
    if all(_match(time, cell) for cell in text):
        return StampForm(text="time of day", pattern=time)
    return None


def _is_date_without_marks(text: Sequence[str], name: str) -> bool:
    return all(re.fullmatch(r"(19|20)\d{6}", cell) for cell in text) and "dat" in name.lower()


def _twelve_hours(text: Sequence[str]) -> bool:
    """Return whether the clock has a morning and an afternoon, as where the month stands first."""
    return text[0][-1:] in "Mm" and "/" in text[0]


def _match(pattern: re.Pattern[str], cell: str) -> bool:
    found = pattern.fullmatch(cell)
    try:
        return found is not None and _seconds(found, {}) is not None
    except (ValueError, KeyError):
        return False


def _other_way_round(text: Sequence[str], order: str) -> bool:
    """Return whether the date may be month/day as well, and the stamps would be other than a constant apart."""
    if order != "day.month.year" or any("." in cell.split()[0] for cell in text):
        return False
    other = re.compile(rf"{_ORDERS['month/day/year']}(?:{_GAP}(?:{_TIME})?{_ZONE})?\s*")
    if not all(_match(other, cell) for cell in text):
        return False
    return len({cell.split()[0] for cell in text}) > 1


def _numeric(values: FloatArray, name: str, unit: str, decimal: str) -> StampForm | None:
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    words = [unit, *re.findall(r"[^\W\d_]+", name)[1:]]
    named = [word for word in words if word.strip(" []()").lower() in UNITS_S]
    if named:
        word = named[0].strip(" []()")
        return StampForm(text=f"numbers in {word}", unit_s=UNITS_S[word.lower()], decimal=decimal)
    middle = float(np.median(np.abs(values)))
    for low, high, unit_s, what in (
        (9e8, 4e9, 1.0, "Unix time in s"),
        (9e11, 4e12, 1e-3, "Unix time in ms"),
        (9e14, 4e15, 1e-6, "Unix time in us"),
        (9e17, 4e18, 1e-9, "Unix time in ns"),
    ):
        if low < middle < high:
            return StampForm(text=what, unit_s=unit_s, decimal=decimal)
    steps = np.diff(values)
    small = steps.size > 0 and 0.0 < float(np.median(steps)) < 0.1
    if small and (3e4 < middle < 6e4 or 7e5 < middle < 8e5):
        return StampForm(text="days of a spreadsheet or of MATLAB", unit_s=_DAY_S, decimal=decimal)
    return StampForm(text="numbers, taken as s", decimal=decimal)


def seconds(cells: Cells, form: StampForm, where: str) -> FloatArray:
    """Return stamps in seconds: since 1970 for dates, since their own zero for numbers; NaN for empty ones.

    Parameters
    ----------
    cells : sequence of str, or (N,) array
        The stamps.
    form : StampForm
        How they are written.
    where : str
        Their file, for the message.

    Raises
    ------
    InputError
        A stamp that is of another form; shows it.

    Notes
    -----
    Dates without a zone are taken as they stand: a clock set back to winter time makes stamps go back. Times of day go
    on past midnight.
    """
    if isinstance(cells, np.ndarray) or form.pattern is None:
        values, empty = numbers(cells, form.decimal)
        if not isinstance(cells, np.ndarray) and (bad := np.isnan(values) & ~empty).any():
            raise _unread(cells[int(np.argmax(bad))], form, where)
        return np.asarray(values * form.unit_s)
    days: dict[tuple[str | None, ...], float] = {}
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        text = cell.strip()
        if not text:
            continue
        found = form.pattern.fullmatch(text)
        try:
            value = None if found is None else _seconds(found, days)
        except (ValueError, KeyError):
            value = None
        if value is None:
            raise _unread(text, form, where)
        values[row] = value
    return values if "Y" in form.pattern.groupindex else _past_midnight(values)


def _unread(cell: str, form: StampForm, where: str) -> InputError:
    return InputError(
        f"the stamp {cell!r} cannot be read as {form.text}",
        where=where,
        remedy="set time_format to its form, for example %d.%m.%Y %H:%M:%S",
    )


def _seconds(found: re.Match[str], days: dict[tuple[str | None, ...], float]) -> float | None:
    """Return the seconds of one stamp; the days of its date are kept, since many stamps share one."""
    groups = found.groupdict()
    date = tuple(groups.get(key) for key in ("Y", "m", "b", "d"))
    if date not in days:
        days[date] = _day_seconds(*date)
    hour, minute = int(groups.get("H") or 0), int(groups.get("M") or 0)
    if groups.get("p"):
        hour = hour % 12 + 12 * (str(groups["p"]).lower() == "p")
    fraction = float(f"0.{groups['f']}") if groups.get("f") else 0.0
    second = int(groups.get("S") or 0)
    if hour > 24 or minute > 59 or second > 60:
        return None
    return days[date] + 3600.0 * hour + 60.0 * minute + second + fraction - _zone_seconds(groups.get("z"))


def _day_seconds(year: str | None, month: str | None, name: str | None, day: str | None) -> float:
    if year is None or day is None:
        return 0.0
    number = int(year) + (0 if len(year) > 2 else 2000 if int(year) < 70 else 1900)
    which = int(month) if month is not None else _MONTHS[str(name).lower()[:3]]
    return _DAY_S * (datetime.date(number, which, int(day)).toordinal() - _EPOCH)


def _zone_seconds(zone: str | None) -> float:
    if not zone or zone in ("Z", "UTC", "GMT"):
        return 0.0
    digits = zone[1:].replace(":", "")
    return (-1.0 if zone[0] == "-" else 1.0) * (3600.0 * int(digits[:2]) + 60.0 * int(digits[2:]))


def _past_midnight(values: FloatArray) -> FloatArray:
    known = np.isfinite(values)
    days = np.cumsum(np.diff(values[known], prepend=values[known][:1]) < -0.5 * _DAY_S)
    values[known] += _DAY_S * days
    return values


def is_milliseconds(cells: Cells, name: str, decimal: str) -> bool:
    """Return whether a column holds the milliseconds of a clock that stands in another column.

    Parameters
    ----------
    cells : sequence of str, or (N,) array
        The column.
    name : str
        Its heading.
    decimal : str
        Its decimal mark.
    """
    word = re.sub(r"[^a-z]", "", name.lower())
    if word not in ("ms", "msec", "millis", "millisec", "milliseconds", "millisecond", "millisekunden", "timems"):
        return False
    values, empty = numbers(cells, decimal)
    known = values[~empty]
    whole = bool(known.size and np.all(np.isfinite(known)) and np.all(known == np.round(known)))
    return whole and bool(known.min() >= 0 and known.max() <= 999) and bool(np.any(np.diff(known) < 0))


def looks_like_date(cell: str) -> bool:
    """Return whether a cell holds a date or a time of day, and no number."""
    return not NUMBER.fullmatch(cell) and detect_form([cell], "") is not None
