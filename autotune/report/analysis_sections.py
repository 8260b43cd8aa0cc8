"""The sections that any page of a design has: Bode points, reduced model, controller and margins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.config.procedure import SignalSettings
from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.nugap import Validation
from autotune.design.specification import Design
from autotune.experiment.result import ExperimentResult
from autotune.identification.parametric import PlantFit
from autotune.pipeline import Analysis
from autotune.points import FrequencyPoint
from autotune.report.figures import (
    Curve,
    bode_figure,
    frequencies,
    gain_phase,
    nichols_figure,
    nyquist_figure,
    ratio_title,
    sensitivity_figure,
)
from autotune.report.maker_forms import maker_table
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Figure, Section, Table

#: a modulus margin that is less by this share cannot be seen in the figure
_DRAWN = 0.01


@dataclass(frozen=True, kw_only=True)
class _Loop:
    """L = H C as something that responds."""

    plant: Any
    controller: PIDController

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        product = self.plant.response(omega_rad_s) * self.controller.response(omega_rad_s)
        return np.asarray(product, dtype=np.complex128)


def analysis_sections(
    analysis: Analysis, signals: SignalSettings, experiment: ExperimentResult | None
) -> tuple[Section, ...]:
    """Return the sections on points, model and loop.

    Parameters
    ----------
    analysis : Analysis
        What is shown.
    signals : SignalSettings
        Units.
    experiment : ExperimentResult or None
        The relay experiment the points came from, for the first-harmonic formulas.
    """
    return (
        _points_section(analysis, signals, experiment),
        _model_section(analysis, signals),
        _loop_section(analysis, signals),
    )


def _grid(analysis: Analysis, decades: float) -> FloatArray:
    """Return the frequencies of a figure [rad/s]: around the points, or around the crossover for a fit in time."""
    if analysis.points and analysis.fit.source == "points":
        return frequencies(analysis.points, decades)
    crossover = analysis.margins.crossover_rad_s
    return np.geomspace(crossover * 10 ** (-decades - 1.0), crossover * 10 ** (decades + 0.3), 400, dtype=np.float64)


def _points_section(analysis: Analysis, signals: SignalSettings, experiment: ExperimentResult | None) -> Section:
    sign = analysis.fit.sign
    omega = _grid(analysis, 0.7)
    estimates = _by_source(analysis.points)
    compared = _described_table(analysis.points, sign, experiment) if experiment else None
    gain_unit = f"{signals.y_unit}/{signals.u_unit}" if signals.u_unit and signals.y_unit else ""
    curves = (
        Curve(name="fitted plant", system=analysis.fit.plant, colour=GREY, dash="dot"),
        *([] if analysis.reduced is None else [Curve(name="reduced model", system=analysis.reduced, colour=GREEN)]),
    )
    return Section(
        title="Bode points",
        text=(
            "Each point is the ratio of the recorded measurement's Fourier coefficient to that of the recorded,"
            " held command over whole periods; its region counts the noise that was found beside the oscillation."
            if all(point.source in _RELAY_SOURCES for point in analysis.points)
            else "All points are of the differential equation with dead time that was fitted to all rows of the sweep,"
            " averaged over its orders: their errors go together. Each region counts the noise, and what the orders"
            " differ by."
            if _is_of_rows(analysis)
            else "Colours tell the estimates apart: relay points come from whole periods of a limit cycle,"
            " closed-loop points from a model of the loop under control, others from a band of frequencies. Each"
            " region counts the noise of its own experiment."
            if len({point.source in _RELAY_SOURCES for point in analysis.points}) > 1
            else "Each point is estimated over a band of frequencies, leakage and drift removed; its region counts"
            " the noise in that band.",
        ),
        tables=(_points_table(analysis.points, sign, gain_unit),),
        figures=(
            Figure(
                figure=bode_figure(estimates, curves, omega, sign, gain_unit),
                caption=("Gain and phase, the phase for the positive gain." if sign < 0 else "Gain and phase.")
                + (
                    " The reduced model lies above the gain and below the phase of the points: margins that a"
                    " controller keeps on it hold for the plant."
                    if analysis.reduced is not None
                    else ""
                ),
                height_px=560,
            ),
        ),
        details=(
            "The first-harmonic formulas trust the delay that was asked for and the relay's ideal wave; their error"
            " against the recorded signals:",
        )
        if compared
        else (),
        detail_tables=(compared,) if compared else (),
    )


_RELAY_SOURCES = ("relay", "harmonic")
_SOURCE_COLOURS = {"relay": BLUE, "harmonic": BLUE, "closed loop": ORANGE, "local polynomial": RED, "spectral": PURPLE}


def _by_source(points: Sequence[FrequencyPoint]) -> list[tuple[str, Sequence[FrequencyPoint], str]]:
    """Return the points in groups of one source and colour, a relay's harmonics with it."""
    groups: dict[str, list[FrequencyPoint]] = {}
    for point in points:
        groups.setdefault("relay" if point.source in _RELAY_SOURCES else point.source, []).append(point)
    if len(groups) == 1:
        return [("measured, 95 %", points, BLUE)]
    return [(f"{name}, 95 %", group, _SOURCE_COLOURS.get(name, GREY)) for name, group in groups.items()]


def _points_table(points: Sequence[FrequencyPoint], sign: int, gain_unit: str) -> Table:
    _, phases = gain_phase(np.array([sign * point.response for point in points], dtype=np.complex128))
    rows = []
    for point, phase in zip(points, phases, strict=True):
        sd = math.sqrt(np.trace(np.array(point.covariance)) / 2.0) / point.gain
        cells = (f"{point.omega_rad_s:.4g}", f"{point.gain:.5g}", f"{phase:.2f}")
        rows.append((*cells, f"{100 * 1.96 * sd:.2g} %", f"{math.degrees(1.96 * sd):.2g}", point.source))
    gain = f"gain [{gain_unit}]" if gain_unit else "gain"
    header = ("ω [rad/s]", gain, "phase [deg]", "gain ±95 %", "phase ±95 % [deg]", "kind")
    return Table(header=header, rows=tuple(rows))


def _described_table(points: Sequence[FrequencyPoint], sign: int, experiment: ExperimentResult) -> Table | None:
    """Return the error of the describing function's estimates, where the experiment was a relay's."""
    described = {segment.point.omega_rad_s: segment.describing for segment in experiment.segments}
    rows = []
    for point in points:
        found = described.get(point.omega_rad_s)
        if found is not None:
            turned = _wrapped(found.phase_rad - float(np.angle(sign * point.response)))
            gain = f"{100 * (found.gain / point.gain - 1):+.0f} %"
            rows.append((f"{point.omega_rad_s:.4g}", gain, f"{math.degrees(turned):+.1f}"))
    return Table(header=("ω [rad/s]", "gain error", "phase error [deg]"), rows=tuple(rows)) if rows else None


def _wrapped(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def _fitted_to(analysis: Analysis) -> str:
    if analysis.fit.source == "recording":
        return "through the recording"
    return "to all rows of the sweep" if _is_of_rows(analysis) else "through the points"


def _is_of_rows(analysis: Analysis) -> bool:
    return bool(analysis.points) and all(point.source == "sweep" for point in analysis.points)


def _model_section(analysis: Analysis, signals: SignalSettings) -> Section:
    reduced, fit = analysis.reduced, analysis.fit
    fitted = (
        f"A transfer function was fitted {_fitted_to(analysis)}:"
        f" {_transfer_text(fit, signals)}."
        # of a recording the noise is estimated from the same residual: its chi-square would say nothing
        + (
            f" Chi-square {fit.chi_square:.1f} with {fit.degrees_of_freedom} degrees of freedom."
            if fit.source == "points" and not _is_of_rows(analysis)
            else ""
        )
        + (f" {len(fit.others)} other structure(s) are not excluded by the data." if fit.others else "")
    )
    if reduced is None or analysis.unscaled is None or analysis.scaled is None:
        why = dict(analysis.alternatives).get("reduced model", "")
        return Section(
            title="Model", text=(fitted, f"There is no reduced model: {why}." if isinstance(why, str) and why else "")
        )
    lag = [("lag frequency ω_0r [rad/s]", f"{reduced.omega_0r_rad_s:.4g}")] if reduced.omega_0r_rad_s else []
    return Section(
        title="Reduced model",
        text=(
            f"{'Integrating' if reduced.integrating else 'Self-regulating'} ({reduced.evidence}). It bounds the plant"
            " from the side that matters: gain from above and phase from below, on the"
            f" {reduced.conditions} of the points.",
            fitted,
        ),
        tables=(
            Table(
                header=("parameter", "value"),
                rows=(
                    (
                        ratio_title("gain G_r", signals.y_unit, signals.u_unit, "s" * reduced.integrating),
                        f"{reduced.G_r:.4g}",
                    ),
                    *lag,
                    ("delay frequency ω_d [rad/s]", f"{reduced.omega_d_rad_s:.4g}"),
                ),
            ),
        ),
        detail_tables=(
            Table(
                caption="The controller carries over from the reduced model H_r to the plant H where ν-gap(H, H_r) <"
                " b(C, H_r) ≤ b(C, H), here on the fitted plant. The numbers depend on the units of u and y; the second"
                " row weighs them as the loop does at its crossover.",
                header=("scaling k", "ν-gap", "b(C, H_r)", "b(C, H)", "holds"),
                rows=(_validation_row(analysis.unscaled), _validation_row(analysis.scaled)),
            ),
        ),
    )


def _validation_row(validation: Validation) -> tuple[str, str, str, str, str]:
    return (
        f"{validation.scaling:.4g}",
        f"{validation.nu_gap:.4f}",
        f"{validation.b_reduced:.4f}",
        f"{validation.b_rig:.4f}",
        "yes" if validation.holds else "no",
    )


def _transfer_text(fit: PlantFit, signals: SignalSettings) -> str:
    plant = fit.plant
    slow = [p for p in plant.poles if p != 0.0 and p.imag >= 0.0]
    lags = ", ".join(
        f"{-1.0 / p.real:.3g} s" if p.imag == 0.0 else f"{abs(p):.3g} rad/s with damping {-p.real / abs(p):.2g}"
        for p in slow
    )
    gain = plant.num[-1] / plant.den[-1 - plant.integrators]
    kind = "integrator" if plant.integrators else "no integrator"
    size = _with_unit(gain, signals.y_unit, f"{signals.u_unit} s" if plant.integrators else signals.u_unit)
    return f"gain {size}, {kind}, lags {lags or 'none'}, dead time {plant.delay_s:.3g} s"


def _loop_section(analysis: Analysis, signals: SignalSettings) -> Section:
    controller, spec = analysis.controller, analysis.design.specification
    omega = _grid(analysis, 1.3)
    loops = (
        Curve(name="fitted plant", system=_Loop(plant=analysis.fit.plant, controller=controller), colour=BLUE),
        *(
            []
            if analysis.reduced is None
            else [
                Curve(
                    name="reduced model" if (_reduced_modulus(analysis) or 0.0) > 0.0 else "reduced model (unstable)",
                    system=_Loop(plant=analysis.reduced, controller=controller),
                    colour=GREEN,
                    dash="dash",
                )
            ]
        ),
    )
    design, m, d = analysis.design, analysis.margins, analysis.design.margins
    binding, u, y = ", ".join(design.binding) or "none", signals.u_unit, signals.y_unit
    rows = (
        (ratio_title("K", u, y), f"{controller.K:.5g}", f"{controller.K:.5g}"),
        ("T_I [s]", f"{controller.Ti_s:.5g}", f"{controller.Ti_s:.5g}"),
        ("modulus margin", f"{d.modulus:.4f}", f"{m.modulus:.4f}"),
        ("phase margin [deg]", f"{math.degrees(d.phase_rad):.2f}", f"{math.degrees(m.phase_rad):.2f}"),
        (ratio_title("noise gain", u, y), f"{d.noise_gain:.4g}", f"{m.noise_gain:.4g}"),
        ("delay margin [s]", f"{d.delay_s:.3g}", f"{m.delay_s:.3g}"),
        ("crossover [rad/s]", f"{d.crossover_rad_s:.4g}", f"{m.crossover_rad_s:.4g}"),
        (ratio_title("H2 norm under load", f"{y} √s" if y else "", u), f"{d.h2:.4g}", f"{m.h2:.4g}"),
    )
    return Section(
        title="Controller and margins",
        text=(
            f"Asked for: modulus margin {spec.modulus_margin:g}, phase margin"
            f" {math.degrees(spec.phase_margin_rad):g} deg, noise gain at most {spec.noise_gain:.4g}"
            f" ({analysis.noise_source}). Binding: {binding}.",
            "Checked: "
            + "; ".join(f"{one.sentence}{'' if one.kept else ' (not kept)'}" for one in analysis.checks)
            + ".",
        ),
        tables=(
            Table(
                caption="The controller on what it was designed with, and on the fitted plant",
                header=("", "designed on", "fitted plant"),
                rows=rows,
            ),
            maker_table(controller),
        ),
        details=(_certificate(analysis),),
        detail_tables=(_price_table(analysis, signals),),
        figures=(
            Figure(
                figure=nyquist_figure(loops, analysis.points, controller, omega, spec.modulus_margin),
                caption=f"Nyquist: {_outside(analysis)}; ellipses are the points' 95 % regions times C.",
                square=True,
            ),
            Figure(
                figure=nichols_figure(loops, omega, spec.modulus_margin, spec.phase_margin_rad),
                caption="Black-Nichols: the required phase margin as a bar, the modulus margin as a closed curve.",
            ),
            Figure(
                figure=sensitivity_figure(loops, omega, spec.modulus_margin),
                caption="Sensitivity: its peak is the inverse of the modulus margin.",
            ),
        ),
    )


def _reduced_modulus(analysis: Analysis) -> float | None:
    """Return the modulus margin of the loop with the reduced model; negative where it is unstable, None without one."""
    if analysis.reduced is None:
        return None
    found = margins(analysis.reduced.transfer_function(), analysis.controller)
    return found.modulus if found.stable else -found.modulus


def _outside(analysis: Analysis) -> str:
    """Return which loops stay outside the circle of the modulus margin, and what the others mean."""
    modulus, asked = _reduced_modulus(analysis), analysis.design.specification.modulus_margin
    if modulus is None:
        return "the loop stays outside the circle of the modulus margin"
    if modulus > asked * (1.0 - _DRAWN):
        return "the loops stay outside the circle of the modulus margin"
    words = f"the plant's loop stays outside the circle of the modulus margin; the controller was {based_on(analysis)}"
    if modulus > 0.0:
        return f"{words}; the reduced model, which is more cautious, enters it (modulus margin {modulus:.2f})"
    return (
        f"{words}; the reduced model beside it has more gain or lag than the plant and would be unstable with this"
        " controller: its curve passes -1 on the other side, and guarantees nothing here"
    )


_PROMISES = {
    "reduced model": "margins of every plant that the reduced model bounds: lags and dead time, falling gain and phase",
    "points": "margins of every aperiodic plant through the points' 95 % regions",
    "fitted plant": "margins of every plant in the 95 % region of the fit, if its structure is right",
}


def _price_table(analysis: Analysis, signals: SignalSettings) -> Table:
    """Return what each guarantee costs: every design judged on the fitted plant."""
    source = analysis.source
    rows = []
    for name, found in ((source, analysis.design), *analysis.alternatives):
        if isinstance(found, str):
            rows.append((name, _PROMISES[name], found, "", "", "", ""))
            continue
        m = margins(analysis.fit.plant, found.controller)
        rows.append(
            (
                name + (" (chosen)" if name == source else ""),
                _PROMISES[name],
                f"{found.controller.K:.4g}",
                f"{found.controller.Ti_s:.4g}",
                f"{m.h2:.4g}",
                f"{m.modulus:.3f}",
                f"{math.degrees(m.phase_rad):.1f}",
            )
        )
    return Table(
        caption="The price of each guarantee: designs of the same specification, judged on the fitted plant",
        header=(
            "designed on",
            "what is promised",
            ratio_title("K", signals.u_unit, signals.y_unit),
            "T_I [s]",
            ratio_title("H2 norm", f"{signals.y_unit} √s" if signals.y_unit else "", signals.u_unit),
            "modulus margin",
            "phase margin [deg]",
        ),
        rows=tuple(rows),
    )


def _certificate(analysis: Analysis) -> str:
    text = analysis.design.certificate
    return f"Certificate: {text}."


def gains_text(controller: PIDController, signals: SignalSettings) -> str:
    """Return a controller's gains in words, with units.

    Parameters
    ----------
    controller : PIDController
        The gains.
    signals : SignalSettings
        Names the units.
    """
    if controller.K == 0.0:
        return "no controller (K = 0)"
    unit = f" {signals.u_unit}/{signals.y_unit}" if signals.u_unit and signals.y_unit else ""
    derivative = f", T_d = {controller.Td_s:.4g} s, T_f = {controller.Tf_s:.3g} s" if controller.kind == "pid" else ""
    return f"{controller.kind.upper()} with K = {controller.K:.4g}{unit}, T_I = {controller.Ti_s:.4g} s{derivative}"


def designed_text(design: Design, signals: SignalSettings) -> str:
    """Return the gains of a design in words; an integral controller as what it is, and as the PI that acts like it.

    Parameters
    ----------
    design : Design
        What is told.
    signals : SignalSettings
        Names the units.
    """
    c, words = design.controller, gains_text(design.controller, signals)
    if not design.is_integral:
        return words
    unit = f" {signals.u_unit}/({signals.y_unit} s)" if signals.u_unit and signals.y_unit else " per s"
    return f"I controller with K_I = {c.K / c.Ti_s:.4g}{unit} (where only a PI is at hand: {words})"


def based_on(analysis: Analysis) -> str:
    """Return in words what the controller was designed on."""
    count = f"{len(analysis.points)} points"
    if analysis.source == "points":
        return f"designed on {count}"
    if analysis.source == "fitted plant":
        return "designed on the plant fitted to the " + ("recording" if analysis.fit.source == "recording" else count)
    return f"designed on the reduced model of {count}"


def margins_sentence(analysis: Analysis, signals: SignalSettings) -> str:
    """Return the margins on the fitted plant in a sentence.

    Parameters
    ----------
    analysis : Analysis
        With its margins.
    signals : SignalSettings
        Names the units.
    """
    m = analysis.margins
    h2 = _with_unit(m.h2, f"{signals.y_unit} √s", signals.u_unit) if signals.y_unit else f"{m.h2:.4g}"
    return (
        f"On the fitted plant: modulus margin {m.modulus:.3f}, phase margin {math.degrees(m.phase_rad):.1f} deg,"
        f" delay margin {m.delay_s:.3g} s, crossover {m.crossover_rad_s:.3g} rad/s, H2 norm under load {h2}."
    )


def _with_unit(value: float, over: str, under: str) -> str:
    return ratio_title(f"{value:.4g}", over, under).translate({ord("["): None, ord("]"): None})
