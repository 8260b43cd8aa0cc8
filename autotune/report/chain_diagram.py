"""The chain as a diagram: from the command to the reading, with the places lit where something is missing."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from autotune.models import Model

#: Sizes in the drawing's own units, which are pixels on a wide page.
_HEIGHT, _GAP, _LINE, _LETTER = 62, 34, 17, 7.6
#: Letters of a line in a box, and boxes in a row.
_WRAP, _MOST = 15, 9


@dataclass(frozen=True, kw_only=True)
class Link:
    """A box of the diagram.

    Attributes
    ----------
    label, below : str
        What stands in it, and in small letters under that.
    place : str
        Where in the rig it is.
    is_added : bool
        Whether the model has no block there: drawn dashed.
    missing : tuple of str
        What is missing there, in a few words each; the box is lit.
    may_be : bool
        Whether it is only one of several places that the data cannot tell apart.
    """

    label: str
    below: str = ""
    place: str = ""
    is_added: bool = False
    missing: tuple[str, ...] = ()
    may_be: bool = False


def chain_diagram(
    model: Model, named: Mapping[str, Sequence[str]], possible: Sequence[str] = (), *, throughout: bool = False
) -> str:
    """Return the chain of a model as inline SVG, lying on a wide page and standing on a narrow one.

    Parameters
    ----------
    model : Model
        Its blocks, input and output.
    named : mapping of str to sequence of str
        What is missing, in a few words each, by place.
    possible : sequence of str
        Further places where it may be as well.
    throughout : bool
        Whether every block of a place is concerned and not its first one alone.
    """
    links = _links(model, named, possible, throughout)
    lit = [f"{link.label}: {', '.join(link.missing) or 'possible'}" for link in links if link.missing or link.may_be]
    says = " to ".join(link.label for link in links) + ("; missing at " + "; ".join(lit) if lit else "; nothing is lit")
    wide, narrow = _draw(links, upright=False), _draw(links, upright=True)
    return (
        f'<div class="chain lying" role="img" aria-label="{html.escape(says)}">{wide}</div>'
        f'<div class="chain upright" aria-hidden="true">{narrow}</div>'
    )


def _links(model: Model, named: Mapping[str, Sequence[str]], possible: Sequence[str], throughout: bool) -> list[Link]:
    """Return the boxes in the order in which a sample passes them; what is missing stands once per place."""
    places = [block.place for block in model.blocks]
    left = {place: tuple(words) for place, words in named.items()}
    links = [Link(label="command u", below=model.input.unit, place="command")]
    for place in ("controller", "timing", "actuator"):
        if (place in left or (place in possible and place != "controller")) and place not in places:
            at = 0 if place == "controller" else len(links)
            links.insert(at, _link_of_addition(place, left.pop(place, ()), place in possible))
    for i, block in enumerate(model.blocks):
        first = block.place not in places[:i]
        if first and block.place == "plant" and ("environment" in left or "environment" in possible):
            links.append(_link_of_addition("environment", left.pop("environment", ()), "environment" in possible))
        words = tuple(named.get(block.place, ())) if first or throughout else ()
        left.pop(block.place, None)
        below = " ".join(filter(None, (block.output if block.output != block.name else "", block.unit)))
        same = block.place in possible and not words and block.place not in named
        links.append(Link(label=block.name, below=below or block.place, place=block.place, missing=words, may_be=same))
    for place in ("plant", "sensor", "environment"):
        if place in left or (place in possible and place not in places and place == "sensor"):
            links.append(_link_of_addition(place, left.pop(place, ()), place in possible))
    return _shorten([*links, Link(label="reading y", below=model.output.unit, place="reading")])


def _shorten(links: list[Link]) -> list[Link]:
    """Return at most so many boxes, what is lit and both ends among them; the others give way from the back."""
    plain = [i for i, one in enumerate(links[1:-1], 1) if not (one.missing or one.may_be)]
    surplus = max(len(links) - _MOST - 2, 0)
    left_out = set(plain[len(plain) - min(surplus, len(plain)) :])
    return [one for i, one in enumerate(links) if i not in left_out]


def _link_of_addition(place: str, words: Sequence[str], possible: bool) -> Link:
    return Link(
        label={"environment": "load on the plant", "timing": "time stamps"}.get(place, place), place=place,
        is_added=True, missing=tuple(words), may_be=possible and not words,
    )  # fmt: skip


def _wrap(text: str, letters: int = _WRAP, lines: int = 2) -> list[str]:
    """Return a text in lines of some letters; what does not fit ends with an ellipsis."""
    rows = [""]
    for word in text.split():
        if rows[-1] and len(rows[-1]) + 1 + len(word) > letters:
            rows.append("")
        rows[-1] = f"{rows[-1]} {word}".strip()
    kept = rows[:lines]
    if len(rows) > lines:
        kept[-1] += " …"
    return [row if len(row) <= letters + 3 else row[: letters + 1] + "…" for row in kept]


def _draw(links: Sequence[Link], *, upright: bool) -> str:
    boxes, x, y = [], 4.0, 4.0
    widths = [_width(link) for link in links]
    widest = max(widths)
    for i, (link, width) in enumerate(zip(links, widths, strict=True)):
        if upright:
            width = widest
        boxes.append(_box(link, x, y, width, beside=upright))
        end = i == len(links) - 1
        if upright:
            below = y + _HEIGHT
            boxes += [] if end else [_arrow(x + width / 2, below, x + width / 2, below + _GAP * 0.6)]
            y += _HEIGHT + _GAP * 0.6
        else:
            boxes += [] if end else [_arrow(x + width, y + _HEIGHT / 2, x + width + _GAP, y + _HEIGHT / 2)]
            x += width + _GAP
    if upright:
        wide, high = widest + 8 + 190, y
    else:
        wide, high = x - _GAP + 8, 4 + _HEIGHT + _LINE * (1 + max(_notes(link) for link in links)) + 4
    return (
        f'<svg viewBox="0 0 {wide:.0f} {high:.0f}" style="max-width:{wide:.0f}px" font-size="14">{"".join(boxes)}</svg>'
    )


def _note_lines(link: Link, letters: int) -> list[str]:
    words = link.missing or (("possibly here",) if link.may_be else ())
    return [line for word in words for line in _wrap(word, letters)]


def _notes(link: Link) -> int:
    return len(_note_lines(link, _WRAP))


def _width(link: Link) -> float:
    texts = [*_wrap(link.label), *_wrap(link.below, lines=1), *_note_lines(link, _WRAP)]
    rounded = 16.0 if link.place in ("command", "reading") else 0.0
    return max(78.0, 20.0 + rounded + _LETTER * max(len(text) for text in texts))


def _arrow(x0: float, y0: float, x1: float, y1: float) -> str:
    across = x1 - x0 > y1 - y0
    tip = (
        f"{x1 - 8:.0f},{y1 - 4:.0f} {x1 - 8:.0f},{y1 + 4:.0f}"
        if across
        else f"{x1 - 4:.0f},{y1 - 8:.0f} {x1 + 4:.0f},{y1 - 8:.0f}"
    )
    return (
        f'<path d="M{x0:.0f} {y0:.0f}L{x1:.0f} {y1:.0f}" class="wire"/>'
        f'<polygon points="{x1:.0f},{y1:.0f} {tip}" class="tip"/>'
    )


def _box(link: Link, x: float, y: float, width: float, *, beside: bool) -> str:
    kind = "lit" if link.missing else "may" if link.may_be else "plain"
    kind += " added" if link.is_added else ""
    is_end = link.place in ("command", "reading")
    parts = [
        f'<rect x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{_HEIGHT}" rx="{22 if is_end else 6}" '
        f'class="{kind}"/>'
    ]
    label, below = _wrap(link.label), _wrap(link.below, lines=1) if link.below else []
    top = y + _HEIGHT / 2 - _LINE * (len(label) + len(below) - 1) / 2 + 5
    for k, line in enumerate([*label, *below]):
        size = ' class="small-print"' if k >= len(label) else ""
        parts.append(_words(x + width / 2, top + k * _LINE, line, size))
    for k, line in enumerate(_note_lines(link, 22 if beside else _WRAP)):
        if beside:
            parts.append(_words(x + width + 10, y + _HEIGHT / 2 + 5 + k * _LINE, line, ' class="note"', "start"))
        else:
            parts.append(_words(x + width / 2, y + _HEIGHT + _LINE * (k + 1), line, ' class="note"'))
    return "".join(parts)


def _words(x: float, y: float, text: str, size: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}"{size}>{html.escape(text, quote=False)}</text>'
