"""The diagnosis as a page for a sceptic: where, what, how sure; unseen rows; the law; what speaks against it."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from autotune.controller import Controller
from autotune.diagnosis.evidence.description import Curve, Description
from autotune.diagnosis.evidence.missing_law import MissingLaw
from autotune.diagnosis.evidence.unseen_run import UnseenRun
from autotune.diagnosis.result import Diagnosis, FoundEffect
from autotune.equations.exports import as_text
from autotune.equations.model import EquationModel
from autotune.equations.typeset import as_mathml
from autotune.errors import InputError
from autotune.models import Parameter
from autotune.report.chain_diagram import chain_diagram
from autotune.report.diagnosis_words import answers, how_they_add_up, in_the_model, objections, places_of, verdict_of
from autotune.report.effect_words import clause, in_short, of_candidates
from autotune.report.law_figures import acting_figure, file_names, free_run_figure, law_figure
from autotune.report.page import Figure, Page, Section, Table, Tone, write_page
from autotune.report.screen_figures import curve_figure, over_time, screen_sections, trace_figures
from autotune.report.writing import number, sentence, typeset_unit, with_spread

_TONES: dict[str, Tone] = {"none": "good", "parameters": "good", "effect": "warn", "unexplained": "bad"}
#: Rivals that are listed, and the probability below which one is none.
_RIVALS, _LEAST = 8, 0.002


@dataclass(frozen=True, kw_only=True, eq=False)
class _Evidence:
    """What the page computes once and says in several places."""

    found: Diagnosis
    run: UnseenRun | None
    laws: tuple[MissingLaw, ...]
    names: tuple[str, ...]


def write_diagnosis_page(
    found: Diagnosis,
    path: str | os.PathLike[str],
    controller: Controller | None = None,
    before: tuple[Section, ...] = (),
    title: str = "Diagnosis",
) -> None:
    """Write the page of a diagnosis.

    Parameters
    ----------
    found : Diagnosis
        What to show.
    path : path
        File to write.
    controller : Controller, optional
        The stated law, where the sidecars do not state it.
    before : tuple of Section
        What led to the diagnosis, shown after its summary.
    title : str
        What was done.
    """
    search = found.search
    known = _Evidence(
        found=found, run=search.unseen_run(), laws=search.laws(), names=file_names(search.recordings)
    )  # fmt: skip
    named, possible = places_of(found)
    page = Page(
        title=f"{title} of {found.extended_model.name}",
        verdict=verdict_of(found),
        tone=_TONES[found.verdict],
        drawing=chain_diagram(search.drawn, named, possible, throughout=search.several_levels),
        answers=answers(found),
        sections=(*before, *_sections(known, controller)),
    )
    write_page(page, path)


def _sections(known: _Evidence, controller: Controller | None) -> tuple[Section, ...]:
    found = known.found
    described = () if found.description is None else (_description_section(found.description, found),)
    traces = Section(title="Simulation against recording", figures=trace_figures(found, known.names))
    return (
        _before_and_after(known),
        *_missing(known),
        *described,
        _when(known),
        _against(known),
        *_determined_sections(found),
        *screen_sections(found, controller, known.names),
        traces,
        *_equations(found),
    )


def _before_and_after(known: _Evidence) -> Section:
    """Show nominal, retuned and extended model on one free run, and their errors there and on all held-out rows."""
    found, run, q = known.found, known.run, known.found.fit
    search = found.search
    held = {"nominal": q.nominal, "retuned": q.retuned, "extended": q.extended}
    if not search.has_effects:
        held.pop("extended")
    rows = [
        (name, "-" if run is None else _share(run.errors.get(name, float("nan"))), _share(error))
        for name, error in held.items()
    ]
    table = Table(
        header=("model", "this stretch", "all held-out stretches"),
        rows=(*rows, ("noise alone", "-", _share(q.noise_floor))),
        caption="Error as a share of the spread of y. A perfect model would come down to the noise.",
    )
    figures = () if run is None else (free_run_figure(run, known.names[run.number]),)
    text = () if run is not None else ("The recordings are too short to leave a stretch of them out.",)
    return Section(
        title="Before and after, as one free run",
        text=text,
        figures=figures,
        tables=(table, _numbers(found)),
        details=(
            "For this picture every number was fitted again without the stretch; which effects were chosen, not. Held-"
            "out stretches: the recordings cut into parts, each run with numbers fitted to the others.",
        ),
    )


def _numbers(found: Diagnosis) -> Table:
    """Return the model's numbers before and after, by block where it has blocks."""
    extended, rows = found.search.has_effects, []
    numbers = found.search.numbers()
    of_blocks = any(n.block for n in numbers)
    for n in numbers:
        fits = (n.retuned, n.value) if extended else (n.retuned,)
        said = [with_spread(Parameter(value=value, sd=sd)) if sd > 0.0 else number(value) for value, sd in fits]
        rows.append((*((n.block,) if of_blocks else ()), n.name, typeset_unit(n.unit) or "-", number(n.nominal), *said))
    header = (*(("block",) if of_blocks else ()), "number", "unit", "nominal", "retuned")
    return Table(
        header=(*header, "extended") if extended else header, rows=tuple(rows),
        caption="Numbers of the model, with 95 % intervals.",
    )  # fmt: skip


def _determined_sections(found: Diagnosis) -> tuple[Section, ...]:
    """Show which combinations of numbers the recordings determine."""
    rows = tuple(
        (", ".join(one.parameters), f"{100.0 * one.narrowed:.3g} %", ", ".join(f"{c:+.2g}" for c in one.changes))
        for one in found.search.combinations()
    )
    table = Table(header=("moves together", "interval, as a share of the prior's", "relative changes"), rows=rows)
    text = "Combinations of numbers, the least determined first: at 100 % the recordings tell nothing new."
    return (Section(title="What the recordings determine", text=(text,), tables=(table,)),) if rows else ()


def _equations(found: Diagnosis) -> tuple[Section, ...]:
    """Show the equations to go on with, where the model is of equations."""
    model = found.extended_model
    if not isinstance(model, EquationModel):
        return ()
    try:
        formulas, lines = as_mathml(model), as_text(model).split("\n\n")[-1].splitlines()
    except InputError:
        formulas, lines = (), ["Effects on samples are listed in extended_model.toml."]
    return (
        Section(
            title="The model to go on with", formulas=formulas, text=tuple(typeset_unit(line) for line in lines if line)
        ),
    )


def _share(error: float) -> str:
    return f"{number(100 * error, 3)} %" if np.isfinite(error) else "runs away"


def _missing(known: _Evidence) -> tuple[Section, ...]:
    """Say what was added: sentences, curves, numbers; what the extended model has is said whatever the verdict."""
    found = known.found
    rows = [row for effect in found.effects for row in _effect_rows(effect)]
    table = Table(header=("effect", "probability", "at", "parameter", "value (95 %)", "equation"), rows=tuple(rows))
    figures = tuple(law_figure(law) for law in known.laws)
    if not rows and not figures and not found.extended_model.effects:
        return ()
    without = [name for name in _added_effects(found) if name not in {law.effect for law in known.laws}]
    text = [] if rows else ["No effect is named."]
    text += [line for line in (in_the_model(found),) if line]
    text += [f"{sentence(clause(name))} That is no law over one signal: the free run shows what it does."
             for name in without]  # fmt: skip
    return (
        Section(
            title="The missing law",
            text=tuple(text),
            figures=figures,
            tables=(table,) if rows else (),
            details=(
                "The dots are not computed from the curve: what the extended model leaves of the readings is traced"
                " back through the model, to first order, to where the effect acts, bin by bin of its signal, and added"
                " to the curve (component plus residual); the other numbers are held.",
            )
            if figures
            else (),
        ),
    )


def _added_effects(found: Diagnosis) -> tuple[str, ...]:
    """Return the effects that the extended model has beyond those that samples alone show."""
    return tuple(e.name for e in found.extended_model.effects)


def _effect_rows(effect: FoundEffect) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    known = (effect.name, f"{effect.probability:.2f}", effect.at or ", ".join(effect.places))
    for i, (name, p) in enumerate(effect.parameters.items()):
        first = known if i == 0 else ("", "", "")
        same = effect.as_command.get(name)
        value = with_spread(p) + (
            f", as a command {with_spread(same)}" if same is not None and same.unit != p.unit else ""
        )
        rows.append((*first, name.replace("_", " "), value, effect.equation if i == 0 else ""))
    return rows or [(*known, "", "", effect.equation)]


def _description_section(description: Description, found: Diagnosis) -> Section:
    """Show what no effect of the catalogue explains, as an equation and as a curve."""
    terms = Table(
        header=("term", "value (95 %)", "unit of the whole"),
        rows=tuple((t.text, f"{t.value:.4g} ± {1.96 * t.sd:.2g}", t.unit) for t in description.terms),
    )
    shares = Table(
        header=("signal", "held-out share"),
        rows=tuple((name, f"{100 * share:.0f} %") for name, share in description.shares.items()),
        caption="What a free curve over each signal takes away of the residual above the noise, on held-out windows.",
    )
    return Section(
        title="A description, not a cause",
        text=(description.sentence,),
        tables=(terms, shares) if description.terms else (shares,),
        figures=(_curve(description.curve, found),) if description.curve.explained > 0.0 else (),
    )


def _curve(curve: Curve, found: Diagnosis) -> Figure:
    caption = (
        f"What is missing over {curve.signal}, as a smoothing spline of no assumed form, with its 95 % band; it "
        f"takes away {100 * curve.explained:.0f} % of the held-out residual above the noise. It tells no offset."
    )
    return Figure(figure=curve_figure(curve, found), caption=caption, height_px=320)


def _when(known: _Evidence) -> Section:
    """Show along the recordings when each effect acts, and how large the residual is."""
    found = known.found
    text = [
        f"{in_short(effect.name).capitalize()}: {_times(effect, known)}."
        for effect in found.effects
        if _is_at_times(effect, known)
    ]
    figures = [acting_figure(law, found.search.recordings, known.names) for law in known.laws]
    title = "When it acts" if known.laws or found.effects else "What is left, along the recordings"
    return Section(title=title, text=tuple(text), figures=(*figures, over_time(found)))


def _is_at_times(effect: FoundEffect, known: _Evidence) -> bool:
    recordings = zip(known.found.order, known.found.search.recordings, strict=True)
    ends = {(i, float(r.t[0]), float(r.t[-1])) for i, r in recordings}
    return set(effect.windows) != ends


def _times(effect: FoundEffect, known: _Evidence, most: int = 6) -> str:
    names = dict(zip(known.found.order, known.names, strict=True))
    said = [f"{a:.4g} to {b:.4g} s of {names[i]}" for i, a, b in effect.windows[:most]]
    more = len(effect.windows) - len(said)
    return ", ".join(said) + (f" and {more} more" if more > 0 else "")


def _against(known: _Evidence) -> Section:
    """Say what speaks against the finding: rivals, what was not excited, what is left."""
    found = known.found
    weighed = of_candidates([(c.name, c.probability) for c in found.candidates], found.verdict)
    rows = [(words, f"{p:.3f}") for words, p in weighed if p >= _LEAST]
    odds = Table(
        header=("explanation", "probability"), rows=tuple(rows[:_RIVALS]),
        caption="All explanations that were weighed, the likeliest first, by all rows and the parts that leave some"
        f" out. {how_they_add_up(found.effects, found.candidates)}",
    )  # fmt: skip
    ranked = found.search.hypotheses()
    table = Table(
        header=("hypothesis", "decrease of chi-square, parameters paid for"),
        rows=tuple((name, f"{decrease:.1f}") for name, decrease in ranked),
    )
    return Section(
        title="What speaks against it",
        text=objections(found, known.run, known.laws),
        tables=(odds,) if rows else (),
        detail_tables=(table,) if ranked else (),
        details=(f"{len(ranked)} combinations of effects were fitted to all rows.",) if ranked else (),
    )
