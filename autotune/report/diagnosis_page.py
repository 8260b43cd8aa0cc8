"""The diagnosis as a page: the verdict, the hypotheses, and what the residuals look like."""

from __future__ import annotations

import os

import numpy as np

from autotune.controller import Controller
from autotune.diagnosis.evidence.description import Curve, Description
from autotune.diagnosis.result import Diagnosis, FoundEffect
from autotune.diagnosis.selection.hypothesis import merged, penalised
from autotune.report.page import Figure, Page, Section, Table, Tone, write_page
from autotune.report.screen_figures import curve_figure, screen_sections, trace_figures

_TONES: dict[str, Tone] = {"none": "good", "parameters": "good", "effect": "warn", "unexplained": "bad"}


def write_diagnosis_page(
    found: Diagnosis,
    path: str | os.PathLike[str],
    controller: Controller | None = None,
    before: tuple[Section, ...] = (),
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
    """
    described = () if found.description is None else (_described(found.description),)
    traces = Section(title="Simulation against recording", figures=trace_figures(found))
    sections = (*before, _effects(found), *described, _fits(found), _hypotheses(found), traces)
    write_page(
        Page(
            title=f"Diagnosis of {found.extended_model.name}",
            verdict=found.sentences[0],
            tone=_TONES[found.verdict],
            summary=(*found.sentences[1:], *_next(found)),
            sections=(*sections, *screen_sections(found, controller)),
        ),
        path,
    )


def _next(found: Diagnosis) -> tuple[str, ...]:
    following = found.next_experiment
    if following is None:
        return ()
    settings = ", ".join(f"{key}: {value}" for key, value in following.settings.items())
    return (f"Next experiment, to {following.purpose}: {following.kind} ({settings}). Expected: {following.expected}.",)


def _effects(found: Diagnosis) -> Section:
    rows = [row for effect in found.effects for row in _effect_rows(effect)]
    text = "Nothing was added to the model." if not rows else "What was added to the model, the most important first."
    table = Table(header=("effect", "probability", "places", "parameter", "value", "equation"), rows=tuple(rows))
    return Section(title="What is missing", text=(text,), tables=(table,) if rows else ())


def _effect_rows(effect: FoundEffect) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for i, (name, p) in enumerate(effect.parameters.items()):
        value = f"{p.value:.4g} ± {1.96 * p.sd:.2g} {p.unit}" if np.isfinite(p.sd) else f"{p.value:.4g} {p.unit}"
        first = (effect.name, f"{effect.probability:.2f}", ", ".join(effect.places)) if i == 0 else ("", "", "")
        rows.append((*first, name, value, effect.equation if i == 0 else ""))
    return rows or [(effect.name, f"{effect.probability:.2f}", ", ".join(effect.places), "", "", effect.equation)]


def _described(description: Description) -> Section:
    """Show what no effect of the catalogue explains, as an equation and as a curve."""
    terms = Table(
        header=("term", "value", "unit of the whole"),
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
        figures=(_curve(description.curve),) if description.curve.explained > 0.0 else (),
    )


def _curve(curve: Curve) -> Figure:
    caption = (
        f"What is missing over {curve.signal}, as a smoothing spline of no assumed form, with its 95 % band; it "
        f"takes away {100 * curve.explained:.0f} % of the held-out residual above the noise. It tells no offset."
    )
    return Figure(figure=curve_figure(curve), caption=caption, height_px=320)


def _fits(found: Diagnosis) -> Section:
    q = found.fit
    table = Table(
        header=("model", "held-out error / spread of y"),
        rows=(
            ("nominal", f"{q.nominal:.4g}"),
            ("retuned", f"{q.retuned:.4g}"),
            ("extended", f"{q.extended:.4g}"),
            ("noise alone", f"{q.noise_floor:.4g}"),
        ),
    )
    retuned = found.search.retuned.fit
    numbers = Table(
        header=("number", "retuned / nominal", "95 %"),
        rows=tuple(
            (
                f.name,
                f"{retuned.parametrisation.value(i, retuned.theta):.5g}",
                f"± {1.96 * np.sqrt(retuned.covariance[i, i]):.2g}",
            )
            for i, f in enumerate(retuned.parametrisation.free)
        ),
        caption="Factors for gain, lags and zeros; dead time and offset in their units.",
    )
    return Section(title="Before and after", tables=(table, numbers))


def _hypotheses(found: Diagnosis) -> Section:
    s = found.search
    base = penalised(s.retuned)
    # pruning and exchanging fit some combinations more than once
    ranked = merged((*s.singles, *s.pairs, *s.triples))
    table = Table(
        header=("hypothesis", "decrease of chi2, parameters paid for"),
        rows=tuple((" + ".join(h.names), f"{base - penalised(h):.1f}") for h in ranked),
    )
    odds = Table(
        header=("candidate", "probability"), rows=tuple((c.name, f"{c.probability:.3f}") for c in found.candidates)
    )
    return Section(title="Other hypotheses", tables=(table, odds))
