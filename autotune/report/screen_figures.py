"""Pictures of the screens: each cheap look at recordings and residuals with the one sentence that it says."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import Controller
from autotune.diagnosis.evidence.description import Curve
from autotune.diagnosis.evidence.screens import (
    LawScreen,
    Means,
    PeriodScreen,
    direction_screen,
    independent_share,
    law_screen,
    means_over,
    period_screen,
    signals_of,
    spectrum_screen,
    stamp_screen,
    value_screen,
    window_screen,
)
from autotune.diagnosis.result import Diagnosis
from autotune.diagnosis.selection.searched import Search
from autotune.report import chart as go
from autotune.report.law_figures import alike_once, style_of
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, Figure, Section, Table, add_line, lines_figure, thin_curve

#: Height of one screen's picture [px]; periods of the recomputed law that are drawn.
HEIGHT, LAW_ROWS = 300, 600
#: Signals that a controller makes, which answers the noise of y, and what is said of them then.
_COMMANDS = ("command u", "u_applied")
_ANSWERS = "in a closed loop the command answers the noise of y, so it need not be flat."
#: Pieces in which a residual's size is drawn over time, and rows of one at least.
PIECES, LEAST_PIECE = 80, 10


def screen_sections(
    found: Diagnosis, controller: Controller | None = None, names: Sequence[str] = ()
) -> tuple[Section, ...]:
    """Return the screens of a diagnosis as sections: samples, residual over time and frequency, over the signals.

    Parameters
    ----------
    found : Diagnosis
        With its search.
    controller : Controller, optional
        The stated law, where the sidecars do not state it.
    names : sequence of str
        The recordings' names for people; their numbers by default.
    """
    samples = _samples(found, controller)
    # what a residual goes with is asked along a linear chain
    return (samples, _residual(found, names), _signals(found)) if isinstance(found.search, Search) else (samples,)


def _samples(found: Diagnosis, controller: Controller | None) -> Section:
    recordings = found.search.recordings
    stamps, values = stamp_screen(recordings), value_screen(recordings)
    u_unit, y_unit = found.search.units
    steps = _histogram(np.concatenate(stamps.steps), "step between time stamps / sample time", (0.9, 1.1), log=True)
    taken = _histogram(values.values, f"y [{y_unit}]", (np.inf, -np.inf))
    figures = [
        Figure(figure=steps, caption=f"Time stamps. {stamps.sentence}", height_px=HEIGHT),
        Figure(figure=taken, caption=f"Readings. {values.sentence}", height_px=HEIGHT),
    ]
    law = law_screen(recordings, controller)
    text = (
        ()
        if law
        else ("There is no controller's law to check: that takes a set-point r, and the law in the sidecar or a file.",)
    )
    if law is not None:
        figures.append(
            Figure(figure=_law(law, u_unit), caption=f"Control law recomputed. {law.sentence}", height_px=HEIGHT)
        )
    return Section(title="What the samples alone show", text=text, figures=tuple(figures))


def _histogram(values: FloatArray, title: str, least: tuple[float, float], *, log: bool = False) -> go.Chart:
    figure = lines_figure(title, "rows", log_y=log)
    edges = np.linspace(min(values.min(), least[0]), max(values.max(), least[1]), 161)
    counts = np.histogram(values, edges)[0]
    if log:
        figure.update_yaxes(range=[-0.3, float(np.log10(2.0 * counts.max()))])
    middle = 0.5 * (edges[1:] + edges[:-1])
    figure.add_trace(go.Bar(x=middle, y=counts, marker={"color": BLUE}, showlegend=False, width=edges[1] - edges[0]))
    return figure


def _law(law: LawScreen, unit: str) -> go.Chart:
    figure = lines_figure("time [s]", f"u [{unit}]")
    near = slice(0, LAW_ROWS)
    add_line(figure, law.t[near], law.recorded[near], "recorded", GREY)
    add_line(figure, law.t[near], law.recomputed[near], "recomputed from r and y", BLUE)
    return figure


def _residual(found: Diagnosis, names: Sequence[str]) -> Section:
    retuned, extended, data = found.search.retuned.fit, found.search.chosen.fit, found.search.data
    y_unit = found.search.units[1]
    spectrum = spectrum_screen(retuned, extended, data)
    figure = lines_figure("frequency [Hz]", f"power density [{y_unit}²/Hz]", log_x=True, log_y=True)
    add_line(figure, spectrum.frequency_hz, spectrum.retuned, "retuned", ORANGE)
    add_line(figure, spectrum.frequency_hz, spectrum.extended, "extended", BLUE)
    add_line(figure, spectrum.frequency_hz, spectrum.noise, "noise model", GREY, dash="dot")
    figures = [Figure(figure=figure, caption=f"Residual over frequency. {spectrum.sentence}", height_px=HEIGHT)]
    periods = period_screen(retuned, data)
    if periods is not None:
        figures += _periods(periods, y_unit, names)
    direction = direction_screen(retuned, data)
    if direction is not None:
        figure = lines_figure(f"|rate of the reading| [{y_unit}/s]", f"residual [{y_unit}]")
        _add_means(figure, direction.rising, "rising", BLUE, data.noise.total_sd)
        _add_means(figure, direction.falling, "falling", ORANGE, data.noise.total_sd)
        figures.append(Figure(figure=figure, caption=f"Up against down. {direction.sentence}", height_px=HEIGHT))
    windows = window_screen(retuned, data)
    if windows is not None:
        figure = lines_figure(windows.against, f"change of {windows.name} [{windows.unit}]")
        bars = {"type": "data", "array": 1.96 * windows.sd, "color": BLUE, "thickness": 1}
        figure.add_trace(
            go.Scatter(x=windows.x, y=windows.change, mode="markers", marker={"color": BLUE, "size": 6}, error_y=bars,
                       showlegend=False)
        )  # fmt: skip
        figures.append(
            Figure(figure=figure, caption=f"Numbers in every window alone. {windows.sentence}", height_px=HEIGHT)
        )
    missing = [] if periods else ["repeated periods and harmonics (no recording's u is periodic)"]
    missing += [] if direction else ["up against down (the reading goes one way only)"]
    missing += [] if windows else ["numbers in every window alone (too few windows)"]
    text = (f"Not looked at: {', '.join(missing)}.",) if missing else ()
    return Section(title="What retuning leaves, when and how fast", text=text, figures=tuple(figures))


def over_time(found: Diagnosis) -> Figure:
    """Draw the size of the residual over time, one recording after the other, in pieces."""
    search, unit = found.search, found.search.units[1]
    figure = lines_figure("t, one recording after the other [s]", f"rms residual [{unit}]")
    pieces, middles, at, row = [], [], 0.0, 0
    longest = max(sum(len(r) for r in search.recordings) // PIECES, LEAST_PIECE)
    for r in search.recordings:
        cuts = np.linspace(0, len(r), max(1, round(len(r) / longest)) + 1).astype(np.int64)
        pieces += [(row + i, row + j) for i, j in pairwise(cuts)]
        middles += [at + 0.5 * (r.t[i] + r.t[j - 1]) - r.t[0] for i, j in pairwise(cuts)]
        at, row = at + r.duration_s, row + len(r)
    t, y = np.array(middles), np.concatenate([r.y for r in search.recordings])
    sizes = {}
    for name, simulated in search.simulated().items():
        squares = (y - np.concatenate(simulated)) ** 2
        kept = [np.isfinite(squares[a:b]) for a, b in pieces]
        means = [np.mean(squares[a:b][ok]) if ok.any() else 0.0 for (a, b), ok in zip(pieces, kept, strict=True)]
        sizes[name] = np.sqrt(np.array(means))
    for name, size in alike_once(sizes).items():
        add_line(figure, t, size, name, style_of(name)[0])
    spread = float(np.nanstd(y)) or 1.0
    noise = found.fit.noise_floor * spread
    add_line(figure, t[[0, -1]], np.full(2, noise), "noise alone", GREY, dash="dot")
    figure.update_yaxes(rangemode="tozero")
    worst, usual = int(np.argmax(sizes["retuned"])), float(np.median(sizes["retuned"]))
    caption = (
        f"Residual over time. Retuned it is usually {usual:.3g} {unit}, at most "
        f"{sizes['retuned'][worst]:.3g} {unit}, near {t[worst]:.4g} s."
    )
    return Figure(figure=figure, caption=caption, height_px=HEIGHT)


def _periods(screen: PeriodScreen, unit: str, names: Sequence[str]) -> list[Figure]:
    folded = lines_figure("time within the period [s]", f"mean residual [{unit}]")
    _band(folded, screen.phase, screen.mean, 1.96 * screen.spread, BLUE)
    add_line(folded, screen.phase, screen.mean, names[screen.number] if names else f"recording {screen.number}", BLUE)
    orders = np.arange(1, screen.harmonics.size + 1)
    bars = lines_figure("harmonic of the period", f"amplitude of the residual [{unit}]")
    for first, name, colour in ((0, "odd", BLUE), (1, "even", ORANGE)):
        bars.add_trace(
            go.Bar(x=orders[first::2], y=screen.harmonics[first::2], name=name, marker={"color": colour}, width=0.6)
        )
    add_line(bars, np.array([0.5, orders[-1] + 0.5]), np.full(2, 3.0 * screen.floor), "noise, 3 sd", GREY, dash="dot")
    return [
        Figure(figure=folded, caption=f"Repeated periods. {screen.sentence}", height_px=HEIGHT),
        Figure(figure=bars, caption=f"Odd and even harmonics. {screen.harmonic_sentence}", height_px=HEIGHT),
    ]


def _signals(found: Diagnosis) -> Section:
    search = found.search
    before = signals_of(search.retuned.fit, search.data)
    after = signals_of(search.chosen.fit, search.data)
    per_row = independent_share(search.retuned.fit)
    curves = {name: means_over(name, *before[name], per_row) for name in before}
    closed = any("r" in r.extra and np.isfinite(r["r"]).any() for r in search.recordings)
    best = max((n for n in curves if not (closed and n in _COMMANDS)), key=lambda name: curves[name].explained)
    figures, rows = [], []
    for name, means in sorted(curves.items(), key=lambda pair: -pair[1].explained):
        figure = lines_figure(_title(name, found), f"residual [{found.search.units[1]}]")
        _add_means(figure, means, "retuned", ORANGE, search.data.noise.total_sd)
        share = "-"
        if name in after:
            extended = means_over(name, *after[name], per_row)
            _add_means(figure, extended, "extended", BLUE, search.data.noise.total_sd)
            share = f"{100 * extended.explained:.1f} %"
        rows.append((name, f"{100 * means.explained:.1f} %", share))
        caption = f"Mean residual over {name} with 95 % bands: "
        caption += _ANSWERS if closed and name in _COMMANDS else "flat at zero where nothing is missing."
        figures.append(Figure(figure=figure, caption=caption, height_px=260))
    table = Table(header=("signal", "retuned", "extended"), rows=tuple(rows),
                  caption="Share of the residual's power that its mean over each signal explains.")  # fmt: skip
    text = f"What retuning leaves goes most with {best} ({100 * curves[best].explained:.1f} % of its power)."
    return Section(title="Residual against every signal", text=(text,), tables=(table,), figures=tuple(figures))


def _title(name: str, found: Diagnosis) -> str:
    """Return the title of a signal's axis, with its unit."""
    model, (u, y) = found.search.retuned.fit.model, found.search.units
    units = {"command u": u, "command": u, "u_applied": u, "plant input": model.plant_input_unit}
    units |= {"reading": y, "position": y, "level": y, "speed": model.speed_unit, "rate of the reading": f"{y}/s"}
    return f"{name} [{units.get(name) or '-'}]" if name in units else name


def _add_means(figure: go.Chart, means: Means, name: str, colour: str, sd: float) -> None:
    _band(figure, means.x, sd * means.mean, 1.96 * sd * means.error, colour)
    add_line(figure, means.x, sd * means.mean, name, colour)


def _band(figure: go.Chart, x: FloatArray, y: FloatArray, half: FloatArray, colour: str) -> None:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    figure.add_trace(
        go.Scatter(
            x=np.concatenate([x, x[::-1]]), y=np.concatenate([y + half, (y - half)[::-1]]), fill="toself",
            fillcolor=f"rgba({red},{green},{blue},0.18)", line={"width": 0}, hoverinfo="skip", showlegend=False,
            mode="lines",
        )
    )  # fmt: skip


def curve_figure(curve: Curve, found: Diagnosis) -> go.Chart:
    """Return the picture of a description's free curve with its 95 % band.

    Parameters
    ----------
    curve : Curve
        The curve with its standard deviation.
    found : Diagnosis
        Names the units.
    """
    figure = lines_figure(_title(curve.signal, found), f"missing [{curve.unit or '-'}]")
    _band(figure, curve.x, curve.value, 1.96 * curve.sd, GREEN)
    add_line(figure, curve.x, curve.value, "free curve", GREEN)
    return figure


def trace_figures(found: Diagnosis, names: Sequence[str]) -> tuple[Figure, ...]:
    """Return every recording with the retuned and the extended simulation, window by window.

    Parameters
    ----------
    found : Diagnosis
        With its simulations.
    names : sequence of str
        One for each recording.
    """
    figures, search = [], found.search
    for i, (r, name, count) in enumerate(zip(search.recordings, names, search.runs(), strict=True)):
        figure = lines_figure("time [s]", f"y [{search.units[1]}]")
        add_line(figure, *thin_curve(r.t, r.y), "measured", GREY, width=1.0)
        for model, y in alike_once({model: runs[i] for model, runs in search.simulated().items()}).items():
            add_line(figure, *thin_curve(r.t, y), model, style_of(model)[0])
        how = "in one run" if count == 1 else f"in {count} windows, the state fitted at the start of each"
        figures.append(Figure(figure=figure, caption=f"{name}: measured, and simulated {how}.", height_px=HEIGHT))
    return tuple(figures)
