"""The diagnosis of equations as a page: verdict, effects, numbers, hypotheses, simulation against recording."""

from __future__ import annotations

import os

import numpy as np

from autotune.diagnosis.equations import EquationDiagnosis
from autotune.equations.black_box import BlackBox
from autotune.equations.effects import equation_of
from autotune.equations.exports import as_text
from autotune.equations.identifiability import combinations
from autotune.errors import InputError
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
    lines_figure,
    thinned,
    write_page,
)  # fmt: skip

_TONES: dict[str, Tone] = {"none": "good", "parameters": "good", "effect": "warn", "unexplained": "bad"}


def write_equations_page(found: EquationDiagnosis, path: str | os.PathLike[str]) -> None:
    """Write the page of a diagnosis of equations.

    Parameters
    ----------
    found : EquationDiagnosis
        What to show.
    path : path
        File to write.
    """
    sections = (_effects(found), _numbers(found), _known(found), _hypotheses(found), _traces(found), _equations(found))
    page = Page(
        title=f"Diagnosis of {found.extended_model.name}", verdict=found.sentences[0], tone=_TONES[found.verdict],
        summary=found.sentences[1:], sections=sections,
    )  # fmt: skip
    write_page(page, path)


def _effects(found: EquationDiagnosis) -> Section:
    rows = []
    for effect, p in zip(found.effects, found.probabilities, strict=True):
        values = ", ".join(
            f"{k} = {q.value:.4g} ± {1.96 * q.sd:.2g} {q.unit}" for k, q in effect.parameters.items() if q.sd > 0.0
        )
        rows.append((effect.name, f"{p:.2f}", effect.state or effect.port or effect.input, values,
                     equation_of(found.equations, effect)))  # fmt: skip
    rows += [(s.name, "", "reading", "", s.equation) for s in found.samples]
    if not rows:
        return Section(title="What is missing", text=("Nothing was added to the model.",))
    table = Table(header=("effect", "probability", "acts on", "parameters (95 %)", "equation"), rows=tuple(rows))
    return Section(title="What is missing", tables=(table,))


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
    return Section(title="Before and after", tables=(errors, numbers))


def _known(found: EquationDiagnosis) -> Section:
    rows = tuple(
        (", ".join(one.parameters), f"{100.0 * one.narrowed:.3g} %", ", ".join(f"{c:+.2g}" for c in one.changes))
        for one in combinations(found.searched.retuned.fitted)
    )
    table = Table(header=("moves together", "left of the belief's width", "relative changes"), rows=rows)
    text = "Combinations of parameters, the least determined first: 100 % is what the model file states."
    return Section(title="What the recordings determine", text=(text,), tables=(table,) if rows else ())


def _hypotheses(found: EquationDiagnosis) -> Section:
    searched = found.searched
    base = searched.score(searched.retuned)
    own = len(searched.retuned.effects)
    ranked = sorted(searched.tried, key=searched.score)
    rows = tuple(
        (" + ".join(f"{e.name} at {e.state or e.port or e.input or 'reading'}" for e in one.effects[own:]),
         f"{base - searched.score(one):.1f}", f"{searched.variance_ratio(one):.3g}")
        for one in ranked
    )  # fmt: skip
    table = Table(header=("hypothesis", "decrease, numbers paid for", "residual variance / noise"), rows=rows)
    odds = Table(
        header=("candidate", "probability"), rows=tuple((c.name, f"{c.probability:.3f}") for c in found.candidates)
    )
    return Section(title="Hypotheses", tables=(table, odds) if rows else (odds,))


def _traces(found: EquationDiagnosis) -> Section:
    figures = []
    for number, recording in enumerate(found.recordings):
        figure = lines_figure("t [s]", "y")
        retuned = found.searched.retuned.fitted.simulated[number]
        extended = found.searched.chosen.fitted.simulated[number]
        add_line(figure, *thinned(recording.t, recording.y), "recorded", GREY)
        add_line(figure, *thinned(recording.t, retuned), "retuned", ORANGE)
        add_line(figure, *thinned(recording.t, extended), "extended", BLUE)
        error = float(np.sqrt(np.nanmean((recording.y - extended) ** 2)))
        figures.append(Figure(figure=figure, caption=f"{recording.name}: the extended model is {error:.3g} off (rms)."))
    return Section(title="Simulation against recording", figures=tuple(figures))


def _equations(found: EquationDiagnosis) -> Section:
    model = found.extended_model
    if isinstance(model, BlackBox):
        return Section(title="The model to go on with", text=("Its equations are inside the given simulation.",))
    try:
        lines = as_text(model).splitlines()
    except InputError:
        lines = ["Effects on samples are listed in extended_model.toml."]
    return Section(title="The model to go on with", text=tuple(line for line in lines if line))
