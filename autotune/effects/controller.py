"""The effect of the controller: a law other than the stated one."""

from __future__ import annotations

from autotune.effects.base import EffectKind, Quantity
from autotune.effects.in_equations import InEquations

CONTROLLER = (
    EffectKind(
        name="controller.law",
        words=("control law", "the command was computed by another law than the stated one"),
        equation="u recomputed from r and y by the stated law differs from the recorded u",
        parameters=(
            Quantity(name="gain_factor", unit="-", role="observed"),
            Quantity(name="T_I_factor", unit="-", role="observed"),
            Quantity(name="T_d_factor", unit="-", role="observed"),
        ),
        sought="law",
        in_equations=InEquations(acts="nothing"),
        reference="Astrom and Hagglund, Advanced PID Control, 2006, ch. 3",
    ),
)
