"""What a controller will do: steps of set-point and load with the band of all plants, and slower and faster ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.config.procedure import SignalSettings
from autotune.controller import PIDController
from autotune.design.law import PILaw
from autotune.design.margins import Margins, margins
from autotune.design.synthesis import design
from autotune.errors import AutotuneError
from autotune.experiment.prediction import Prediction, predict
from autotune.models import TransferFunction
from autotune.one_thread import on_one_thread
from autotune.pipeline import Analysis
from autotune.report.chart import Chart, make_subplots
from autotune.report.figures import axis_title, ratio_title
from autotune.report.page import BLUE, GREY, ORANGE, Figure, Section, Table, add_line
from autotune.report.writing import number

#: Plants that are drawn from the region.
DRAWS = 40
#: Modulus margins of the controllers that are drawn beside the designed one, as far as they are apart from its own.
FAMILY, APART = (0.4, 0.6, 0.7, 0.8), 0.04
#: Samples of either step; how long one takes, in times of the crossover's and in T_I, and no less than in dead times.
_SAMPLES, _CROSSOVERS, _INTEGRALS, _DEAD_TIMES = 500, 14.0, 5.0, 8.0
#: Overshoot above which a set-point weight is offered, and the weights that are tried.
OVERSHOOT, WEIGHTS = 0.1, (0.8, 0.6, 0.4, 0.2, 0.0)
_SLIDER = (
    "The slider goes from careful to fast, to controllers of other modulus margins M_m on the fitted plant; the band is"
    " that of the designed one, which keeps what was asked on the region."
)
#: A band that is nowhere wider than this share of what is drawn is not seen beside its line.
_SEEN = 0.01
#: A response that leaves this many times the step is of a loop that is not stable: its band ends there.
_FAR = 20.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Member:
    """A controller of the family with what it is expected to do.

    Attributes
    ----------
    name : str
        For the slider.
    controller : PIDController
        Gains.
    kept : Margins
        On the fitted plant.
    worst : float
        Smallest modulus margin of the plants that were drawn; negative where one is not stable, NaN of none.
    prediction : Prediction
        Of a step of the set-point and one of the load.
    """

    name: str
    controller: PIDController
    kept: Margins
    worst: float
    prediction: Prediction


@on_one_thread
def outlook_section(
    analysis: Analysis, signals: SignalSettings, present: PIDController | None = None
) -> tuple[Section, ...]:
    """Return the section on what the loop is expected to do; none where the fitted plant's loop is not stable.

    Parameters
    ----------
    analysis : Analysis
        Plant and controller.
    signals : SignalSettings
        Units.
    present : PIDController, optional
        The gains in use today, drawn beside the new ones.
    """
    fit, controller = analysis.fit, analysis.controller
    if not analysis.margins.stable or not math.isfinite(analysis.margins.crossover_rad_s):
        return ()
    plants = fit.draws(DRAWS, np.random.default_rng(0))
    present = _in_use(present)
    times, load = _times(analysis, present), abs(controller.K)
    designed = _member("designed", fit.plant, plants, controller, times, load)
    family = sorted([designed, *_family(analysis, times, load)], key=lambda member: member.kept.modulus, reverse=True)
    before = None if present is None else _member("today", fit.plant, plants, present, times, load)
    return (
        Section(
            title="What the loop will do",
            text=(
                f"Predicted, not measured: a step of the set-point by {_amount(1.0, signals.y_unit)}, then one of the"
                f" load by {_amount(load, signals.u_unit)}. The band{_band_width(designed)} holds 95 % of {DRAWS}"
                " plants drawn from what the data leave open.",
                *_gain_text(designed, before, "today's gains"),
                *_weight_text(designed, fit.plant, times, load),
            ),
            tables=(
                Table(
                    header=(
                        "",
                        ratio_title("K", signals.u_unit, signals.y_unit),
                        "T_I [s]",
                        "modulus margin",
                        "worst drawn plant",
                        "overshoot",
                        f"peak under load [{signals.y_unit}]" if signals.y_unit else "peak under load",
                        "load settled to 5 % [s]",
                    ),
                    rows=tuple(_row(one, float(times[1])) for one in (*([before] if before else []), *family)),
                ),
            ),
            figures=(
                Figure(
                    figure=_figure(family, designed, before, times, signals),
                    caption=_SLIDER if len(family) > 1 else "",
                    height_px=600,
                ),
            ),
        ),
    )


@on_one_thread
def outlook_sentences(analysis: Analysis, present: PIDController | None = None) -> tuple[str, ...]:
    """Return how much better than those before the new ones are, and a set-point weight where steps overshoot much.

    Parameters
    ----------
    analysis : Analysis
        Plant and controller.
    present : PIDController, optional
        The gains that were in use before.
    """
    fit, controller = analysis.fit, analysis.controller
    if not analysis.margins.stable or not math.isfinite(analysis.margins.crossover_rad_s):
        return ()
    present = _in_use(present)
    times, load = _times(analysis, present), abs(controller.K)
    designed = _member("designed", fit.plant, (), controller, times, load)
    before = None if present is None else _member("today", fit.plant, (), present, times, load)
    weight = _weight_text(designed, fit.plant, times, load)
    sentences = (*_gain_text(designed, before, "the gains before"), *weight)
    said = " ".join(sentences)
    return (f"On the fitted plant, {said[0].lower()}{said[1:]}",) if sentences else ()


def _amount(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".strip()


def _in_use(present: PIDController | None) -> PIDController | None:
    """Return the gains before, None where the device holds none: a gain of zero is what nobody has set."""
    return None if present is None or present.K == 0.0 else present


def _times(analysis: Analysis, present: PIDController | None) -> FloatArray:
    """Return the instants of a prediction [s]: two steps, each long enough to settle."""
    controller, crossover = analysis.controller, analysis.margins.crossover_rad_s
    lasts = [_CROSSOVERS / crossover, _DEAD_TIMES * analysis.fit.plant.delay_s]
    lasts += [_INTEGRALS * c.Ti_s for c in (controller, present) if c is not None and math.isfinite(c.Ti_s)]
    each = min(max(lasts), 10.0 * max(lasts[0], lasts[1]))
    return np.linspace(0.0, 2.0 * each, 2 * _SAMPLES, endpoint=False)


def _member(
    name: str, plant: TransferFunction, plants: Sequence[TransferFunction], controller: PIDController, t: FloatArray,
    load: float,
) -> Member:  # fmt: skip
    """Return a controller with its margins and its predicted steps."""
    law = PILaw(controller=controller, sample_time_s=float(t[1]))
    disturbance, quiet = np.where(np.arange(t.size) >= _SAMPLES, load, 0.0), np.random.default_rng(0)
    found = predict(plant, plants or (plant,), law, np.ones(t.size), disturbance, 0.0, quiet, u_rest=0.0)
    if plants:
        draws = np.clip(np.nan_to_num(found.y_draws, nan=_FAR), -_FAR, _FAR)
        low, high = np.quantile(draws, [0.025, 0.975], axis=0)
        found = replace(found, low=np.minimum(low, found.y), high=np.maximum(high, found.y))
    each = [margins(one, controller) for one in plants]
    worst = min((m.modulus if m.stable else -1.0 for m in each), default=math.nan)
    return Member(name=name, controller=controller, kept=margins(plant, controller), worst=worst, prediction=found)


def _gain_text(designed: Member, before: Member | None, name: str) -> tuple[str, ...]:
    """Return by how much a load's error is smaller than with those of before, where these hold the plant."""
    if before is None or not before.kept.stable:
        return ()
    now, then = (float(np.sum(np.abs(one.prediction.y[_SAMPLES:] - 1.0))) for one in (designed, before))
    times = f"{number(then / now, 2)} times smaller" if then > now else f"{number(now / then, 2)} times larger"
    return (f"The integral of the error that a load leaves is {times} than with {name}.",)


def _weight_text(designed: Member, plant: TransferFunction, t: FloatArray, load: float) -> tuple[str, ...]:
    """Return a set-point weight under which the set-point's step overshoots less, where it overshoots much."""
    if _overshoot(designed.prediction) <= OVERSHOOT or designed.controller.setpoint_weight != 1.0:
        return ()
    for weight in WEIGHTS:
        tried = _member("", plant, (), replace(designed.controller, setpoint_weight=weight), t, load)
        if _overshoot(tried.prediction) <= OVERSHOOT or weight == WEIGHTS[-1]:
            before, after = (f"{100.0 * _overshoot(one.prediction):.0f} %" for one in (designed, tried))
            return (
                f"With a set-point weight b = {weight:g} the set-point's step overshoots {after} instead of {before};"
                " what the loop makes of loads stays the same.",
            )
    return ()


def _overshoot(prediction: Prediction) -> float:
    """Return the largest excess over a unit step of the set-point."""
    return max(float(np.max(prediction.y[:_SAMPLES])) - 1.0, 0.0)


def _family(analysis: Analysis, times: FloatArray, load: float) -> list[Member]:
    """Return controllers that keep other modulus margins on the fitted plant, none where there is none."""
    asked, kind = analysis.design.specification, "pid" if analysis.controller.Td_s > 0.0 else "pi"
    found = []
    for modulus in FAMILY:
        if abs(modulus - analysis.margins.modulus) < APART:
            continue
        # a phase margin of 45 deg would keep the faster ones from being faster
        phase_rad = min(asked.phase_margin_rad, 2.0 * math.asin(0.5 * modulus))
        other = replace(asked, modulus_margin=modulus, phase_margin_rad=phase_rad)
        try:
            controller = design(analysis.fit.plant, other, kind, certificate=False).controller  # type: ignore[arg-type]
        except AutotuneError:
            continue
        member = _member("", analysis.fit.plant, (), controller, times, load)
        if abs(member.kept.modulus - analysis.margins.modulus) < APART:
            continue
        # named by what it keeps: where another margin or the noise gain binds, that is not what was asked
        found.append(replace(member, name=f"M_m\u00a0{member.kept.modulus:.2f}"))
    return found


def _band_width(member: Member) -> str:
    """Say that a band is not to be seen, where its line covers it."""
    prediction = member.prediction
    widest = float(np.nanmax(prediction.high - prediction.low))
    return ", narrower than its line," if widest < _SEEN * float(np.ptp(prediction.y)) else ""


def _row(member: Member, sample_s: float) -> tuple[str, ...]:
    """Return a controller's row: gains, margins, overshoot, peak and how long a load takes."""
    y, c = member.prediction.y, member.controller
    second = y[_SAMPLES:] - 1.0
    peak = float(np.max(np.abs(second)))
    late = np.flatnonzero(np.abs(second) > 0.05 * peak)
    settled = f"{sample_s * (late[-1] + 1):.3g}" if late.size and late[-1] < second.size - 1 else "not shown"
    worst = "" if math.isnan(member.worst) else f"{member.worst:.3f}" if member.worst > 0.0 else "not stable"
    overshoot = f"{100.0 * _overshoot(member.prediction):.0f} %"
    gains = f"{c.K:.4g}", f"{c.Ti_s:.4g}", f"{member.kept.modulus:.3f}"
    return (member.name, *gains, worst, overshoot, f"{peak:.3g}", settled)


def _figure(
    family: Sequence[Member], designed: Member, before: Member | None, t: FloatArray, signals: SignalSettings
) -> Chart:
    """Draw y over u for the designed controller, with today's beside it, and a slider to the others."""
    chart = make_subplots(rows=2, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.64, 0.36])
    if before is not None:
        add_line(chart, t, before.prediction.y, "today", GREY, dash="dash", row=1, col=1)
        add_line(chart, t, before.prediction.u, "today", GREY, dash="dash", row=2, col=1, showlegend=False)
    band = {"mode": "lines", "line": {"width": 0}, "hoverinfo": "skip", "showlegend": False}
    low, high = designed.prediction.low, designed.prediction.high
    chart.add_scatter(x=t, y=low, row=1, col=1, **band)
    chart.add_scatter(x=t, y=high, fill="tonexty", fillcolor="rgba(59,130,196,0.25)", row=1, col=1, **band)
    fixed = len(chart.data)
    for member in family:
        shown = member is designed
        add_line(chart, t, member.prediction.y, "y", BLUE, row=1, col=1, visible=shown)
        add_line(chart, t, member.prediction.u, "u", ORANGE, row=2, col=1, visible=shown)
    steps = []
    for i, member in enumerate(family):
        visible = [True] * fixed + [j // 2 == i for j in range(2 * len(family))]
        steps.append({"method": "restyle", "args": [{"visible": visible}], "label": member.name})
    slider = {
        "active": list(family).index(designed), "steps": steps, "pad": {"t": 64, "b": 4}, "ticklen": 4, "x": 0.02,
        "len": 0.94, "currentvalue": {"visible": False},
    }  # fmt: skip
    chart.update_layout(sliders=[slider] if len(family) > 1 else [])
    chart.update_yaxes(title=axis_title("Δy", signals.y_unit), row=1, col=1)
    chart.update_yaxes(title=axis_title("Δu", signals.u_unit), row=2, col=1)
    chart.update_xaxes(title="time [s]", row=2, col=1)
    return chart
