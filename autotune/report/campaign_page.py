"""A campaign as one page: every loop, what needs attention first on top."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from autotune.batch.row import ATTENTION, Attention, Row
from autotune.batch.settings import CampaignSettings
from autotune.report.glance import glance, identity
from autotune.report.page import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    Anchor,
    Figure,
    Page,
    Picture,
    Section,
    Table,
    Tone,
    lines_figure,
)

_TITLES: dict[Attention, str] = {
    "act": "Needs action",
    "failed": "Not analysed",
    "look": "Deserves a look",
    "designed": "New gains to try",
    "fine": "Fine",
}
#: Of one loop, of several.
_WORDS: dict[Attention, tuple[str, str]] = {
    "act": ("needs action", "need action"),
    "failed": ("could not be analysed", "could not be analysed"),
    "look": ("deserves a look", "deserve a look"),
    "designed": ("has new gains to try", "have new gains to try"),
    "fine": ("is fine", "are fine"),
}
_COLOURS: dict[Attention, str] = {"act": RED, "failed": GREY, "look": ORANGE, "designed": BLUE, "fine": GREEN}

_SURE_IN_OPERATION = (
    "A valve is blamed where the past of its position predicts y better than the command does, and better than it"
    " would in the same loop with a linear valve. Each row says how much better, over how many reversals and by which"
    " chance."
)
_TODO_IN_OPERATION: dict[Attention, str] = {
    "act": "See to the valves and gains under 'Needs action' first, from the top; each with the test that tells.",
    "failed": "Read why the loops under 'Not analysed' failed; each names its remedy.",
    "look": "Loops that oscillate, not by their valve as far as is seen: look upstream, or make the test that tells.",
    "designed": "",
    "fine": "Nothing to do; look again when a loop oscillates.",
}

_Columns = dict[str, Callable[[Row], str | Picture | Anchor]]


def campaign_page(settings: CampaignSettings, rows: Sequence[Row]) -> Page:
    """Return the page of a campaign.

    Parameters
    ----------
    settings : CampaignSettings
        What was asked.
    rows : sequence of Row
        In the order of the table of results.
    """
    counts = Counter(row.attention for row in rows)
    tone: Tone = "bad" if counts["act"] else "warn" if counts["failed"] or counts["look"] else "good"
    said = ", ".join(
        f"{counts[attention]} {_words(settings)[attention][counts[attention] > 1]}"
        for attention in ATTENTION
        if counts[attention]
    )
    asked_modulus, asked_phase = settings.design.margins
    summary = ["Sorted by what needs attention first; all figures are in results.parquet."]
    if settings.task == "design":
        summary.append(
            f"Designed for a modulus margin of {asked_modulus:.2g} and a phase margin of {np.degrees(asked_phase):.0f} "
            f"deg. A loop's own page: autotune tune {_own_page(settings)}."
        )
    if settings.task == "routine":
        summary.append(
            "The worst come first: valves by what they explain that the command does not, then oscillations by their"
            " share of y. A loop's own page: autotune diagnose --routine FILE --out DIR."
        )
    sections = [_section(settings, attention, rows) for attention in ATTENTION if counts[attention]]
    return Page(
        title=settings.name,
        verdict=f"Of {len(rows)} loops, {said}.",
        tone=tone,
        answers=_answers(counts, settings),
        drawing=glance(rows, _COLOURS, _titles(settings)),
        summary=tuple(summary),
        sections=(*sections, *_present_margins(settings, rows), *_notes(rows)),
    )


def _titles(settings: CampaignSettings) -> dict[Attention, str]:
    """Return the titles of the tables: a loop that was only identified is not known to be fine."""
    return _TITLES | ({"fine": "Identified"} if settings.task == "identify" else {})


def _words(settings: CampaignSettings) -> dict[Attention, tuple[str, str]]:
    """Return what the loops of a table are said to be, of one and of several."""
    return _WORDS | ({"fine": ("is identified", "are identified")} if settings.task == "identify" else {})


def _answers(counts: Counter[Attention], settings: CampaignSettings) -> tuple[tuple[str, str], ...]:
    """Return what to do, the most pressing first."""
    first: Attention = next((attention for attention in ATTENTION if counts[attention]), "fine")
    if settings.task == "routine":
        return ("How sure", _SURE_IN_OPERATION), ("What to do", _TODO_IN_OPERATION[first])
    todo = {
        "act": "Retune what needs action first: its margins are missed or physics is missing.",
        "failed": "Read why the loops under 'Not analysed' failed; each names its remedy.",
        "look": "Look at the loops that could do better when there is time.",
        "designed": "Try the new gains; where K and Ti_s of today are given, loops are ranked by what is to be gained.",
        "fine": "Nothing to do."
        if settings.task != "identify"
        else 'Nothing is said of the gains in use: task = "design" looks for better ones.',
    }
    sure = "Every figure rests on the loop's own record; what was left out of it is said under Notes."
    return ("How sure", sure), ("What to do", todo[first])


def _own_page(settings: CampaignSettings) -> str:
    """Return what ``autotune tune`` is to be given to design a loop of the campaign again, with the same gains."""
    if settings.method == "closed-loop":
        return "--points loops/NAME.json --out DIR"
    return "FILE --out DIR, with --u and --y where FILE has several loops"


def _section(settings: CampaignSettings, attention: Attention, rows: Sequence[Row]) -> Section:
    columns: _Columns = {
        "loop": lambda row: Anchor(says=row.loop, identity=identity(row)),
        "area": lambda row: row.area,
    }
    if attention not in ("designed", "fine"):
        columns["why"] = lambda row: row.reason.removeprefix(f"{row.loop}: ")
    columns |= _FAILED if attention == "failed" else _COLUMNS[settings.task]
    chosen = [row for row in rows if row.attention == attention]
    cells = [tuple(cell(row) for cell in columns.values()) for row in chosen]
    shown = [i for i in range(len(columns)) if any(line[i] for line in cells)]
    table = Table(
        header=tuple(list(columns)[i] for i in shown), rows=tuple(tuple(line[i] for i in shown) for line in cells)
    )
    return Section(title=f"{_titles(settings)[attention]} ({len(chosen)})", tables=(table,))


def _number(value: float | None, form: str = ".4g") -> str:
    return "" if value is None else format(value, form)


def _gains(row: Row, K: float | None, Ti_s: float | None) -> str:
    unit = f"\N{NO-BREAK SPACE}{row.u_unit}/{row.y_unit}" if row.u_unit and row.y_unit else ""
    return "" if K is None else f"{K:.4g}{unit}, {_number(Ti_s)}\N{NO-BREAK SPACE}s"


def _margins(modulus: float | None, phase_deg: float | None) -> str:
    return "" if modulus is None else f"{modulus:.2f},\N{NO-BREAK SPACE}{_number(phase_deg, '.0f')}°"


def _present(row: Row) -> str:
    return "unstable" if row.stable_now is False else _margins(row.modulus_now, row.phase_now_deg)


def _record(row: Row) -> str:
    if not row.rows or row.duration_s is None:
        return ""
    bad = f", {100 * (row.bad_rows or 0) / row.rows:.2g} % bad" if row.bad_rows else ""
    pieces = f" in {row.pieces}" if row.pieces and row.pieces > 1 else ""
    return f"{_time(row.duration_s)}{pieces}, {row.rows}\N{NO-BREAK SPACE}rows{bad}"


def _time(seconds: float) -> str:
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.3g}\N{NO-BREAK SPACE}{unit}"
    return f"{seconds:.3g}\N{NO-BREAK SPACE}s"


def _range(row: Row) -> str:
    if row.omega_low_rad_s is None or row.omega_high_rad_s is None:
        return ""
    return f"{row.omega_low_rad_s:.3g} to {row.omega_high_rad_s:.3g}"


def _error(row: Row) -> str:
    if row.nominal is None:
        return ""
    return f"{_number(row.nominal, '.3g')} → {_number(row.extended, '.3g')} ({_number(row.noise_floor, '.3g')})"


def _step(row: Row) -> str | Picture:
    if not row.step or row.step_s is None:
        return ""
    values = np.array(row.step.split(), dtype=np.float64)
    return Picture(values=values, says=f"response to a step over {_time(row.step_s)}")


def _gain(row: Row) -> str:
    unit = f"\N{NO-BREAK SPACE}{row.y_unit}/{row.u_unit}" if row.u_unit and row.y_unit else ""
    per_second = "/s" if row.integrators else ""
    return "" if row.gain is None else f"{row.gain:.3g}{unit}{per_second}"


_FAILED: _Columns = {"file": lambda row: row.file.rsplit("/", 1)[-1], "record": _record}
_COLUMNS: dict[str, _Columns] = {
    "identify": {
        "points": lambda row: str(row.points or ""),
        "range [rad/s]": _range,
        "record": _record,
    },
    "design": {
        "plant's step": _step,
        "gain": _gain,
        "lags [s]": lambda row: (row.lags_s or "") + (", integrator" if row.integrators else ""),
        "dead time [s]": lambda row: _number(row.dead_time_s, ".3g"),
        "new K, Ti": lambda row: _gains(row, row.K, row.Ti_s),
        "modulus, phase margin": lambda row: _margins(row.modulus, row.phase_deg),
        "present K, Ti": lambda row: _gains(row, row.K_now, row.Ti_now_s),
        "present margins": _present,
        "record": _record,
    },
    "diagnose": {
        "verdict": lambda row: row.verdict or "",
        "error → after (noise)": _error,
        "record": _record,
    },
    "routine": {
        "how sure": lambda row: row.sure or "",
        "band of u": lambda row: _band(row),
        "period": lambda row: "" if row.period_s is None else _time(row.period_s),
        "next": lambda row: row.what_next or "" if row.attention != "fine" else "",
        "record": _record,
    },
}


def _band(row: Row) -> str:
    if row.band is None or row.band_of_range is None:
        return ""
    unit = f"\N{NO-BREAK SPACE}{row.u_unit}" if row.u_unit else ""
    return f"{row.band:.3g}{unit} ({100.0 * row.band_of_range:.0f} %)"


def _present_margins(settings: CampaignSettings, rows: Sequence[Row]) -> tuple[Section, ...]:
    """Return a figure of the margins that the loops run with, where their controllers were given."""
    known = [row for row in rows if row.stable_now and row.modulus_now is not None]
    if not known:
        return ()
    modulus, phase = settings.design.margins
    figure = lines_figure("phase margin [deg]", "modulus margin")
    for attention in ATTENTION:
        of_kind = [row for row in known if row.attention == attention]
        if of_kind:
            figure.add_scatter(
                x=[row.phase_now_deg for row in of_kind],
                y=[row.modulus_now for row in of_kind],
                text=[row.loop for row in of_kind],
                name=_TITLES[attention].lower(),
                mode="markers",
                marker={"color": _COLOURS[attention], "size": 9},
                hovertemplate="%{text}<br>%{x:.0f} deg, %{y:.2f}<extra></extra>",
            )
    figure.add_hline(y=modulus, line={"color": GREY, "dash": "dot"})
    figure.add_vline(x=float(np.degrees(phase)), line={"color": GREY, "dash": "dot"})
    unstable = sum(row.stable_now is False for row in rows)
    beyond = f" {unstable} unstable loops have no margins and are not shown." if unstable else ""
    caption = f"Each point is a loop with its present controller; dotted, what was asked.{beyond}"
    return (Section(title="Present margins", figures=(Figure(figure=figure, caption=caption),)),)


def _notes(rows: Sequence[Row]) -> tuple[Section, ...]:
    noted = [(row.loop, row.notes) for row in rows if row.notes]
    return (Section(title="Notes", tables=(Table(header=("loop", "notes"), rows=tuple(noted)),)),) if noted else ()
