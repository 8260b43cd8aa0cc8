"""Is a controller one that an engineer would believe? A look at it beside SIMC's and AMIGO's PI for the same plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.rules import amigo, simc
from autotune.errors import AutotuneError
from autotune.models import TransferFunction

#: a response to load so many times larger than a rule's, or an integral time so many times apart, is told
_FAR_NORM, _FAR_TIME = 2.5, 10.0
#: damping below which a plant is none that the rules were made for
_APERIODIC = 0.7


@dataclass(frozen=True, kw_only=True)
class RuleController:
    """What a tuning rule gives.

    Attributes
    ----------
    rule : str
        Its name.
    controller : PIDController
        Its PI.
    h2 : float
        Norm (11) on the plant; infinite where the loop is unstable.
    """

    rule: str
    controller: PIDController
    h2: float


def by_rules(plant: TransferFunction, sample_time_s: float = 0.0) -> tuple[RuleController, ...]:
    """Return the PI of SIMC and AMIGO for a plant; none for a plant that the rules are not made for.

    Parameters
    ----------
    plant : TransferFunction
        Fitted plant.
    sample_time_s : float
        Of the loop, which adds at least one of itself to the dead time; the rules need one.
    """
    if any(abs(p.imag) > 0.0 and -p.real < _APERIODIC * abs(p) for p in plant.poles):
        return ()
    seen = replace(plant, delay_s=plant.delay_s + sample_time_s)
    found = []
    for name, rule in (("SIMC", simc), ("AMIGO", amigo)):
        try:
            controller = rule(seen)
            found.append(RuleController(rule=name, controller=controller, h2=margins(plant, controller).h2))
        except (AutotuneError, ArithmeticError, ValueError):  # a rule that does not know this plant has no say
            continue
    return tuple(found)


def implausible(
    plant: TransferFunction, controller: PIDController, binding: Sequence[str], sample_time_s: float = 0.0
) -> str | None:
    """Return in a sentence how a controller is far from what both rules give, or None where it is not.

    Parameters
    ----------
    plant : TransferFunction
        Fitted plant.
    controller : PIDController
        The design.
    binding : sequence of str
        Constraints that hold it back.
    sample_time_s : float
        Of the loop [s].
    """
    rules = by_rules(plant, sample_time_s)
    if not rules:
        return None
    h2 = margins(plant, controller).h2
    said = []
    worse = min(h2 / rule.h2 for rule in rules)
    if worse > _FAR_NORM:
        said.append(f"a step of load moves y {worse:.1f} times as much as with either")
    nearest = min(rule.controller.Ti_s for rule in rules)
    farthest = max(rule.controller.Ti_s for rule in rules)
    if controller.Ti_s < nearest / _FAR_TIME or controller.Ti_s > farthest * _FAR_TIME:
        said.append(f"an integral time of {controller.Ti_s:.3g} s is far from theirs")
    if not said:
        return None
    theirs = ", ".join(f"{r.rule} K = {r.controller.K:.3g}, T_I = {r.controller.Ti_s:.3g} s" for r in rules)
    held = f"; what holds it back: {', '.join(binding)}" if binding else ""
    return f"unlike any tuning rule ({theirs}): {'; '.join(said)}{held}"
