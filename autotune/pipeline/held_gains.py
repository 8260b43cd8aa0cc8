"""Gains as the rig's own controller can hold them: rounded to its registers, they are the controller."""

from __future__ import annotations

import math
from dataclasses import replace

from autotune.config.procedure import DesignSettings
from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.nugap import loop_scaling, validate
from autotune.errors import InputError
from autotune.experiment.rig import Rig, RoundsGains
from autotune.identification.parametric import PlantFit
from autotune.pipeline.analysis import Analysis, check_controller

#: largest relative change of a gain by rounding; a fifth of the gain is a fifth of the disturbance's area
MOVED = 0.2
#: share of a margin that rounding may take where the exact gains only just keep what was asked for
KEPT = 0.95


def round_to_rig(
    rig: Rig, controller: PIDController, settings: DesignSettings, *, fit: PlantFit | None = None
) -> PIDController:
    """Return the controller that the rig would hold after these gains were written; nothing is written.

    Parameters
    ----------
    rig : Rig
        Closed.
    controller : PIDController
        Exact gains.
    settings : DesignSettings
        Which margins were asked for.
    fit : PlantFit, optional
        Plant on which the margins of the rounded gains are checked; without it the gains alone are compared.

    Returns
    -------
    PIDController
        The exact gains where the rig does not round.

    Raises
    ------
    InputError
        The registers' resolution spoils the gains or their margins; names the registers and a scale that would do. Or
        the rig has no place for the controller.
    """
    if not isinstance(rig, RoundsGains):
        return controller
    held = rig.holdable(controller)
    reason = _moved_gain(controller, held) or (_lost_margin(controller, held, settings, fit) if fit is not None else "")
    if reason:
        raise InputError(
            f"the rig's registers are too coarse for K = {controller.K:.4g}, T_I = {controller.Ti_s:.4g} s: {reason}",
            where="gains",
            remedy="nothing was written; " + "; ".join(rig.coarse(controller)),
        )
    return held


def on_registers(analysis: Analysis, held: PIDController) -> Analysis:
    """Return the analysis with the gains as the rig holds them, and their margins in place of the exact gains'.

    Parameters
    ----------
    analysis : Analysis
        With the exact gains.
    held : PIDController
        The gains as the registers hold them.
    """
    if held == analysis.controller:
        return analysis
    plant = analysis.fit.plant
    H_r = None if analysis.reduced is None else analysis.reduced.transfer_function()
    rounded = margins(H_r if H_r is not None and analysis.source == "reduced model" else plant, held)
    said = "the norm and the margins are those of the gains as the rig's registers hold them"
    return replace(
        analysis,
        design=replace(
            analysis.design,
            controller=held,
            margins=rounded,
            h2=rounded.h2,
            certificate="; ".join(part for part in (analysis.design.certificate, said) if part),
        ),
        margins=margins(plant, held),
        checks=check_controller(analysis, held),
        unscaled=None if H_r is None else validate(plant, H_r, held),
        scaled=None if H_r is None else validate(plant, H_r, held, scaling=loop_scaling(H_r, held)),
    )


def _moved_gain(exact: PIDController, held: PIDController) -> str:
    """Return which gain rounding moves too far, and how far."""
    moved = []
    for name in ("K", "Ti_s", "Td_s", "Tf_s"):
        a, b = getattr(exact, name), getattr(held, name)
        if not (a == b or abs(b - a) <= MOVED * abs(a)):  # an infinite time apart from itself is too far
            moved.append(f"{name} would be {b:.4g}")
    return ", ".join(moved)


def _lost_margin(exact: PIDController, held: PIDController, settings: DesignSettings, fit: PlantFit) -> str:
    """Return which margin rounding takes away."""
    if held == exact:
        return ""
    wanted_modulus, wanted_phase_rad = settings.margins
    before, after = margins(fit.plant, exact), margins(fit.plant, held)
    if not after.stable:
        return "the rounded gains make no stable loop on the measured plant"
    if after.modulus < min(wanted_modulus, KEPT * before.modulus):
        return f"the rounded gains have a modulus margin of {after.modulus:.3f} in place of {before.modulus:.3f}"
    if after.phase_rad < min(wanted_phase_rad, KEPT * before.phase_rad):
        phases = [math.degrees(m.phase_rad) for m in (after, before)]
        return f"the rounded gains have a phase margin of {phases[0]:.1f} deg in place of {phases[1]:.1f} deg"
    if after.noise_gain > max(settings.noise_gain or 0.0, before.noise_gain / KEPT):
        return f"the rounded gains amplify noise {after.noise_gain:.3g} times in place of {before.noise_gain:.3g}"
    return ""
