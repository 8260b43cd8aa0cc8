"""An analysis in words: its gains, what they are based on, its margins."""

from __future__ import annotations

import math

from autotune.config.procedure import SignalSettings
from autotune.controller import PIDController
from autotune.design.specification import Design
from autotune.identification.parametric import LEAST_POINTS
from autotune.pipeline import Analysis
from autotune.pipeline.analysis import of_use
from autotune.report.figures import (
    ratio_title,
)


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


def basis_text(analysis: Analysis) -> str:
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
    h2 = with_units(m.h2, f"{signals.y_unit} √s", signals.u_unit) if signals.y_unit else f"{m.h2:.4g}"
    return (
        f"On the fitted plant: modulus margin {m.modulus:.3f}, phase margin {math.degrees(m.phase_rad):.1f} deg,"
        f" delay margin {m.delay_s:.3g} s, crossover {m.crossover_rad_s:.3g} rad/s, H2 norm under load {h2}."
    )


def with_units(value: float, over: str, under: str) -> str:
    """Return a value with the unit of a ratio.

    Parameters
    ----------
    value : float
        The value.
    over, under : str
        Units of the ratio's two parts; may be empty.
    """
    return ratio_title(f"{value:.4g}", over, under).translate({ord("["): None, ord("]"): None})


def reason_without_reduced(analysis: Analysis) -> str:
    """Return why there is no reduced model, and what is to be done where one is wanted; empty where nobody knows."""
    usable = len(of_use(analysis.points))
    if analysis.fit.source == "recording" and usable < LEAST_POINTS:
        shown = {0: "none", 1: "one"}.get(usable, "two")
        return (
            "There is no reduced model, and this controller does not need one: it was designed on the"
            f" {analysis.source}. A reduced model takes at least three frequency points; of u and y as they were"
            f" recorded {shown} can be told. To have one, record while u goes up and down both slowly and fast, or let"
            " a relay measure points (autotune run)."
        )
    why = dict(analysis.alternatives).get("reduced model", "")
    return f"There is no reduced model: {why.removeprefix('reduced model: ')}." if isinstance(why, str) and why else ""
