"""The sections that any page of a design has: Bode points, reduced model, controller and margins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.config.procedure import SignalSettings
from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.nugap import Validation
from autotune.identification.parametric import PlantFit
from autotune.pipeline import Analysis
from autotune.report.analysis_words import basis_text, reason_without_reduced, with_units
from autotune.report.figures import Curve, ratio_title
from autotune.report.loop_diagrams import nichols_figure, nyquist_figure, sensitivity_figure
from autotune.report.maker_forms import maker_table
from autotune.report.page import BLUE, GREEN, Figure, Section, Table
from autotune.report.points_section import frequency_grid, is_of_rows, points_section

if TYPE_CHECKING:  # a page from recordings is written without what runs a rig
    from autotune.experiment.result import ExperimentResult

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
        points_section(analysis, signals, experiment),
        _model_section(analysis, signals),
        _loop_section(analysis, signals),
    )


def _source_text(analysis: Analysis) -> str:
    if analysis.fit.source == "recording":
        return "through the recording"
    return "to all rows of the sweep" if is_of_rows(analysis) else "through the points"


def _model_section(analysis: Analysis, signals: SignalSettings) -> Section:
    reduced, fit = analysis.reduced, analysis.fit
    fitted = (
        f"A transfer function was fitted {_source_text(analysis)}:"
        f" {_transfer_text(fit, signals)}."
        # of a recording the noise is estimated from the same residual: its chi-square would say nothing
        + (
            f" Chi-square {fit.chi_square:.1f} with {fit.degrees_of_freedom} degrees of freedom."
            if fit.source == "points" and not is_of_rows(analysis)
            else ""
        )
        + (f" {len(fit.others)} other structure(s) are not excluded by the data." if fit.others else "")
    )
    if reduced is None or analysis.unscaled is None or analysis.scaled is None:
        return Section(title="Model", text=(fitted, reason_without_reduced(analysis)))
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
    lags = [f"{-1.0 / p.real:.3g} s" for p in slow if p.imag == 0.0]
    pairs = "".join(
        f", an oscillating pair at {abs(p):.3g} rad/s with damping {-p.real / abs(p):.2g}" for p in slow if p.imag > 0.0
    )
    gain = plant.num[-1] / plant.den[-1 - plant.integrators]
    kind = "integrator" if plant.integrators else "no integrator"
    size = with_units(gain, signals.y_unit, f"{signals.u_unit} s" if plant.integrators else signals.u_unit)
    lagging = f"lag{'s' * (len(lags) > 1)} {', '.join(lags)}" if lags else "no lag"
    return f"gain {size}, {kind}, {lagging}{pairs}, dead time {plant.delay_s:.3g} s"


def _loop_section(analysis: Analysis, signals: SignalSettings) -> Section:
    controller, spec = analysis.controller, analysis.design.specification
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
            _margins_table(analysis.source, rows),
            maker_table(controller),
        ),
        details=(f"Certificate: {analysis.design.certificate}.",),
        detail_tables=(_price_table(analysis, signals),),
        figures=_loop_figures(analysis),
    )


def _margins_table(source: str, rows: Sequence[tuple[str, str, str]]) -> Table:
    """Return gains and margins: of all that the controller was designed for, and of the fitted plant; once if alike."""
    if source != "fitted plant":
        caption = f"On the {source}, which the controller was designed on, and on the fitted plant"
        return Table(caption=caption, header=("", source, "fitted plant"), rows=tuple(rows))
    caption = "On the fitted plant, and the least over the region of it that the controller was designed for"
    two = tuple((name, on_plant, least) for name, least, on_plant in rows)
    if all(on_plant == least for _, on_plant, least in two):
        caption = "On the fitted plant, which the controller was designed on"
        return Table(caption=caption, header=("", source), rows=tuple(row[:2] for row in two))
    return Table(caption=caption, header=("", source, "least over its region"), rows=two)


def _loop_figures(analysis: Analysis) -> tuple[Figure, ...]:
    controller, spec = analysis.controller, analysis.design.specification
    omega = frequency_grid(analysis, 1.3)
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
    return (
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
    outside = "outside the circle of the modulus margin"
    if modulus is None or modulus > asked * (1.0 - _DRAWN):
        return f"the loop stays {outside}" if modulus is None else f"the loops stay {outside}"
    words = f"the plant's loop stays {outside}; the controller was {basis_text(analysis)}"
    if modulus > 0.0:
        return f"{words}; the reduced model, which is more cautious, enters it (modulus margin {modulus:.2f})"
    return (
        f"{words}; the reduced model beside it has more gain or lag than the plant and would be unstable with this"
        " controller: its curve passes -1 on the other side, and guarantees nothing here"
    )


_PROMISES = {
    "reduced model": "margins of every plant that the reduced model bounds: lags and dead time, falling gain and phase",
    "points": "margins of every aperiodic plant through the points' 95 % regions",
    "fitted plant": "margins of every plant as far from the fit as a rig of that structure lies in 95 of 100",
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


def warnings_sections(warnings: Sequence[str]) -> tuple[Section, ...]:
    """Return a section of warnings, each said once; none where there are none."""
    return (Section(title="Warnings", text=tuple(dict.fromkeys(warnings))),) if warnings else ()
