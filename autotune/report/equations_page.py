"""The diagnosis of equations as a page: verdict, effects, numbers, hypotheses, simulation against recording."""

from __future__ import annotations

import os

import numpy as np

from autotune.diagnosis.equations import EquationDiagnosis
from autotune.equations.black_box import BlackBox
from autotune.equations.effects import equation_of, where_told
from autotune.equations.exports import as_text
from autotune.equations.identifiability import combinations
from autotune.errors import InputError
from autotune.report.chart import make_subplots
from autotune.report.diagnosis_words import next_in_words
from autotune.report.effect_words import clause, joined, of_candidate, with_spread
from autotune.report.law_figures import file_names, with_unit
from autotune.report.page import (
    BLUE,
    GREY,
    ORANGE,
    Figure,
    Page,
    Section,
    Table,
    Tone,
    add_line,
    thinned,
    write_page,
)  # fmt: skip

_TONES: dict[str, Tone] = {"none": "good", "parameters": "good", "effect": "warn", "unexplained": "bad"}
#: Probability below which an explanation is not listed.
_LEAST = 0.002


def write_equations_page(found: EquationDiagnosis, path: str | os.PathLike[str]) -> None:
    """Write the page of a diagnosis of equations.

    Parameters
    ----------
    found : EquationDiagnosis
        What to show.
    path : path
        File to write.
    """
    sections = (_traces(found), _effects(found), _numbers(found), _against(found), _known(found), _equations(found))
    page = Page(
        title=f"Diagnosis of {found.extended_model.name}", verdict=_verdict(found), tone=_TONES[found.verdict],
        answers=_answers(found), summary=found.sentences[1:-1], sections=sections,
    )  # fmt: skip
    write_page(page, path)


def _verdict(found: EquationDiagnosis) -> str:
    """Return the verdict in a sentence, effects in words with their names and places in brackets."""
    if found.verdict != "effect":
        return found.sentences[0]
    told = [
        f"{clause(e.name)} ({e.name} at {where_told(e)}, probability {p:.2f})"
        for e, p in zip(found.effects, found.probabilities, strict=True)
    ]
    told += [f"{clause(s.name)} ({s.name})" for s in found.samples]
    return f"The model leaves physics out: {joined(told)}." if told else found.sentences[0]


def _answers(found: EquationDiagnosis) -> tuple[tuple[str, str], ...]:
    following = found.next_experiment
    go_on = {"none": "Go on with the model as it is."}.get(found.verdict, "Go on with extended_model.toml.")
    return (
        ("How sure", _sure(found)),
        ("What to do", f"{go_on} {next_in_words(following) if following is not None else ''}".strip()),
    )


def _sure(found: EquationDiagnosis) -> str:
    nominal, retuned, extended, noise = (f"{100.0 * error:.3g} %" for error in found.errors)
    return (
        f"Error on the last third of every recording, with numbers fitted to the rest, as a share of the spread of y: "
        f"nominal {nominal}, retuned {retuned}, extended {extended}; noise alone {noise}."
    )


def _effects(found: EquationDiagnosis) -> Section:
    rows = []
    for effect, p in zip(found.effects, found.probabilities, strict=True):
        values = ", ".join(
            f"{k.replace('_', ' ')} = {with_spread(q)}" for k, q in effect.parameters.items() if q.sd > 0.0
        )
        rows.append((effect.name, f"{p:.2f}", where_told(effect), values,
                     equation_of(found.equations, effect)))  # fmt: skip
    rows += [(s.name, "", "reading", "", s.equation) for s in found.samples]
    named = {effect.name for effect in found.effects} | {s.name for s in found.samples}
    more = [effect for effect in found.extended_model.effects if effect.name not in named]
    text = ["No effect is named."] if not rows else []
    if more:
        said = joined([f"{clause(effect.name)} ({effect.name})" for effect in more])
        text.append(
            f"The extended model has, beyond what is named: {said}. It stands there because it predicts unseen rows "
            "better, or was in the given model; it is not a finding."
        )
    table = Table(header=("effect", "probability", "acts on", "parameters (95 %)", "equation"), rows=tuple(rows))
    return Section(title="What is missing", text=tuple(text), tables=(table,) if rows else ())


def _numbers(found: EquationDiagnosis) -> Section:
    names = ("nominal", "retuned", "extended", "noise alone")
    errors = Table(
        header=("model", "held-out error / spread of y"),
        rows=tuple((name, f"{error:.4g}") for name, error in zip(names, found.errors, strict=True)),
    )
    fitted = found.searched.chosen.fitted
    rows = [
        (p.name, f"{n.value:.5g}", f"{v:.5g}", f"± {1.96 * s:.2g}" if s else "as given", p.unit)
        for p, n, v, s in zip(
            fitted.compiled.parameters, found.searched.nominal.fitted.compiled.parameters, fitted.parameters, fitted.sd,
            strict=False,
        )
    ]  # fmt: skip
    numbers = Table(header=("parameter", "nominal", "now", "95 %", "unit"), rows=tuple(rows))
    return Section(title="Numbers", tables=(errors, numbers))


def _known(found: EquationDiagnosis) -> Section:
    rows = tuple(
        (", ".join(one.parameters), f"{100.0 * one.narrowed:.3g} %", ", ".join(f"{c:+.2g}" for c in one.changes))
        for one in combinations(found.searched.retuned.fitted)
    )
    table = Table(header=("moves together", "left of the belief's width", "relative changes"), rows=rows)
    text = "Combinations of parameters, the least determined first: 100 % is what the model file states."
    return Section(title="What the recordings determine", text=(text,), tables=(table,) if rows else ())


def _against(found: EquationDiagnosis) -> Section:
    """Say what else was weighed, and how probable it remains."""
    searched = found.searched
    base = searched.score(searched.retuned)
    own = len(searched.retuned.effects)
    rows = tuple(
        (" + ".join(f"{e.name} at {where_told(e)}" for e in one.effects[own:]),
         f"{base - searched.score(one):.1f}", f"{searched.variance_ratio(one):.3g}")
        for one in sorted(searched.tried, key=searched.score)
    )  # fmt: skip
    table = Table(header=("hypothesis", "decrease, numbers paid for", "residual variance / noise"), rows=rows)
    odds = Table(
        header=("explanation", "probability"),
        rows=tuple((of_candidate(c.name), f"{c.probability:.3f}") for c in found.candidates if c.probability > _LEAST),
        caption="All explanations that were weighed, the likeliest first. An effect's own probability is the sum of"
        " those that have it.",
    )
    once = ("There is one recording: what is the rig's and what is that day's cannot be told apart.",)
    return Section(
        title="What speaks against it",
        text=once if len(found.recordings) == 1 else (),
        tables=(odds,),
        detail_tables=(table,) if rows else (),
    )


def _traces(found: EquationDiagnosis) -> Section:
    """Draw every recording with the simulations through it, the residual below."""
    figures, unit = [], found.equations.output_unit
    fits = {"retuned": (found.searched.retuned.fitted, ORANGE, "dash")}
    if found.searched.chosen is not found.searched.retuned:
        fits["extended"] = (found.searched.chosen.fitted, BLUE, "solid")
    for number, (r, name) in enumerate(zip(found.recordings, file_names(found.recordings), strict=True)):
        figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.05, row_heights=[0.66, 0.34])
        add_line(figure, *thinned(r.t, r.y), "recorded", GREY, width=2.4, row=1, col=1)
        errors = []
        for model, (one, colour, dash) in fits.items():
            left = r.y - one.simulated[number]
            add_line(figure, *thinned(r.t, one.simulated[number]), model, colour, dash=dash, row=1, col=1)
            add_line(figure, *thinned(r.t, left), model, colour, dash=dash, row=2, col=1, showlegend=False)
            errors.append(f"{model} {float(np.sqrt(np.nanmean(left**2))):.3g} {unit}".strip())
        figure.update_yaxes(title=with_unit("y", unit), row=1, col=1)
        figure.update_yaxes(title=with_unit("residual", unit), row=2, col=1)
        figure.update_xaxes(title="t [s]", row=2, col=1)
        figures.append(Figure(figure=figure, caption=f"{name}: root mean square error {', '.join(errors)}."))
    return Section(
        title="Before and after",
        text=("Simulations with the numbers fitted to all rows; the errors above are those on rows left out.",),
        figures=tuple(figures),
    )


def _equations(found: EquationDiagnosis) -> Section:
    model = found.extended_model
    if isinstance(model, BlackBox):
        return Section(title="The model to go on with", text=("Its equations are inside the given simulation.",))
    try:
        lines = as_text(model).splitlines()
    except InputError:
        lines = ["Effects on samples are listed in extended_model.toml."]
    return Section(title="The model to go on with", text=tuple(line for line in lines if line))
