"""The diagnosis as a page: the verdict, the hypotheses, and what the residuals look like."""

from __future__ import annotations

import os

import numpy as np

from autotune.diagnosis.result import Diagnosis, FoundEffect
from autotune.diagnosis.selection import score
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
)

_TONES: dict[str, Tone] = {"none": "good", "parameters": "good", "effect": "warn", "unexplained": "bad"}


def write_diagnosis_page(found: Diagnosis, path: str | os.PathLike[str]) -> None:
    """Write the page of a diagnosis.

    Parameters
    ----------
    found : Diagnosis
        What to show.
    path : path
        File to write.
    """
    sections = (_effects(found), _fits(found), _hypotheses(found), _traces(found), _residuals(found))
    write_page(
        Page(
            title=f"Diagnosis of {found.extended_model.name}",
            verdict=found.sentences[0],
            tone=_TONES[found.verdict],
            summary=(*found.sentences[1:], *_next(found)),
            sections=sections,
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
    base = score(s.retuned)
    ranked = sorted((*s.singles, *s.pairs, *s.triples), key=score)
    table = Table(
        header=("hypothesis", "decrease of chi2, parameters paid for"),
        rows=tuple((" + ".join(h.names), f"{base - score(h):.1f}") for h in ranked),
    )
    odds = Table(
        header=("candidate", "probability"), rows=tuple((c.name, f"{c.probability:.3f}") for c in found.candidates)
    )
    return Section(title="Rivals", tables=(table, odds))


def _traces(found: Diagnosis) -> Section:
    figures = []
    for i, r in enumerate(found.search.data.recordings):
        figure = lines_figure("t [s]", f"y [{found.extended_model.output.unit}]")
        add_line(figure, *thinned(r.t, r.y), "measured", GREY, width=1.0)
        add_line(figure, *thinned(r.t, found.search.retuned.fit.signals[i][:, 0]), "retuned", ORANGE)
        add_line(figure, *thinned(r.t, found.search.chosen.fit.signals[i][:, 0]), "extended", BLUE)
        figures.append(Figure(figure=figure, caption=f"Recording {i}: measured, and simulated window by window."))
    return Section(title="Simulation against recording", figures=tuple(figures))


def _residuals(found: Diagnosis) -> Section:
    figures = []
    for column, name in ((1, "speed"), (2, "position"), (3, "plant input")):
        figure = lines_figure(name, "residual / noise")
        for fit, label, colour in (
            (found.search.retuned.fit, "retuned", ORANGE),
            (found.search.chosen.fit, "extended", BLUE),
        ):
            x = np.concatenate([s[:, column] for s in fit.signals])
            e = np.concatenate(fit.residuals) / found.search.data.noise.total_sd
            ok = np.isfinite(x)
            order = np.argsort(x[ok])
            parts = np.array_split(order, 40)
            add_line(
                figure,
                np.array([x[ok][p].mean() for p in parts]),
                np.array([e[ok][p].mean() for p in parts]),
                label,
                colour,
            )
        figures.append(
            Figure(
                figure=figure, caption=f"Mean residual against {name}: flat where nothing is missing.", height_px=300
            )
        )
    return Section(title="Residual against the signals", figures=tuple(figures))
