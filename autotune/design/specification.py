"""What a controller is asked for, and what a synthesis answers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.figures import CONSTRAINTS, Figures, require_frequency
from autotune.design.margins import Margins
from autotune.distributions import chi2_quantile
from autotune.errors import DesignError
from autotune.models import LARGEST, SMALLEST

Kind: TypeAlias = Literal["pi", "pid"]
#: relative slack below which a constraint counts as binding
_EQUAL = {"h2": 1e-4, "iae": 3e-3}
#: what a certificate says of margins that need not hold on every plant that the measurements allow
UNCERTAIN = "not certain:"
#: of the joint region of points on which margins are kept, and that a rig keeps all that were kept about its fit
PROBABILITY = 0.95
#: a margin as small as this asks for nothing, and its reciprocal is no gain
_LEAST = 1e-9


@dataclass(frozen=True, kw_only=True)
class Specification:
    """Constraints (18) on the loop.

    Attributes
    ----------
    modulus_margin : float
        M_m of (12), between 0 and 1.
    phase_margin_rad : float
        phi_d of (13) [rad], between 0 and pi/2.
    noise_gain : float
        N_max: largest amplification of measurement noise to command, input unit per output unit, so that no default
        would mean the same on two rigs.
    noise : {"true", "bound"}
        ``true`` keeps (15) itself, abs(C/(1 + L)) <= N_max for omega >= omega_n; ``bound`` keeps (16), abs(C) <=
        M_m N_max there, which implies (15) wherever the modulus margin is kept and so never asks for less.
    noise_frequency_rad_s : float, optional
        omega_n of (15) and (16) [rad/s]; the crossover where absent.
    delay_margin_s : float
        Smallest delay margin [s]; 0 asks for none.
    criterion : {"h2", "iae"}
        What is minimised after a step of load: the norm (11), or the integral of the absolute error.
    setpoint_command : float
        Largest immediate command per unit step of the set-point, abs(K) times the set-point weight, which is lowered
        where it has to be; infinite asks for nothing. It limits the actuator's jump, not its later excursion.

    Raises
    ------
    DesignError
        A value outside its range; names it.
    """

    modulus_margin: float = 0.5
    phase_margin_rad: float = math.pi / 4.0
    noise_gain: float
    noise: Literal["bound", "true"] = "true"
    noise_frequency_rad_s: float | None = None
    delay_margin_s: float = 0.0
    setpoint_command: float = math.inf
    criterion: Literal["h2", "iae"] = "h2"

    def __post_init__(self) -> None:
        def refuse(name: str, value: float, allowed: str) -> None:
            raise DesignError(f"{name} = {value:g}", where="specification", remedy=f"it must be {allowed}")

        if not _LEAST < self.modulus_margin < 1.0:
            refuse("modulus margin", self.modulus_margin, "between 0 and 1")
        if not _LEAST < self.phase_margin_rad < math.pi / 2.0:
            refuse("phase margin", math.degrees(self.phase_margin_rad), "between 0 and 90 degrees")
        if not 0.0 < self.noise_gain < math.inf:
            refuse("noise gain", self.noise_gain, "a positive number")
        if self.delay_margin_s != 0.0 and not SMALLEST <= self.delay_margin_s <= LARGEST:
            refuse("delay margin", self.delay_margin_s, "a time in s, not negative")
        if not self.setpoint_command > 0.0:
            refuse("set-point command", self.setpoint_command, "positive")

        if self.noise_frequency_rad_s is not None:
            require_frequency("noise frequency", self.noise_frequency_rad_s)

    @property
    def largest_gain(self) -> float:
        """Largest abs(K) of a PI on a strictly proper plant: M_m N_max by (16), N_max by (15), as L ends at 0."""
        return self.modulus_margin * self.noise_gain if self.noise == "bound" else self.noise_gain

    @property
    def distance(self) -> float:
        """How many standard deviations from a fit plants keep each margin asked for, so that the rig keeps all of them.

        Near the fit a margin is linear in its parameters, however many: the rig misses one with the probability of a
        normal distribution's tail (Hasofer and Lind 1974), and any of them at most with the sum (Bonferroni).
        """
        asked = 3 if self.delay_margin_s > 0.0 else 2
        return math.sqrt(chi2_quantile(1.0 - 2.0 * (1.0 - PROBABILITY) / asked, 1))

    def slacks(self, figures: Figures) -> FloatArray:
        """Return (..., 4) relative slacks in the order of CONSTRAINTS: negative where violated, infinite if not asked.

        Parameters
        ----------
        figures : Figures
            Of one loop, or of many in arrays of one shape.
        """
        if self.noise == "true":
            noise = figures.noise_gain / self.noise_gain
        else:
            noise = figures.controller_gain / (self.modulus_margin * self.noise_gain)
        if self.delay_margin_s > 0.0:
            delay = figures.delay_s / self.delay_margin_s - 1.0
        else:
            delay = np.full(np.shape(noise), np.inf) if np.ndim(noise) else np.inf
        modulus, phase = figures.modulus / self.modulus_margin - 1.0, figures.phase_rad / self.phase_margin_rad - 1.0
        found = np.array((modulus, phase, 1.0 - noise, delay))
        return found if found.ndim == 1 else np.moveaxis(found, 0, -1)

    def binding(self, figures: Figures) -> tuple[str, ...]:
        """Return the names of the constraints that hold with equality, as near as the search of the criterion ends."""
        slack = self.slacks(figures)
        return tuple(
            name for name, value in zip(CONSTRAINTS, slack, strict=True) if abs(value) < _EQUAL[self.criterion]
        )


def spec1(noise_gain: float) -> Specification:
    """Return Spec1: M_m = 0.5 and 45 degrees, for a plant that does not vary and a model held correct."""
    return Specification(modulus_margin=0.5, phase_margin_rad=math.radians(45.0), noise_gain=noise_gain)


def spec2(noise_gain: float) -> Specification:
    """Return Spec2: M_m = 0.8 and 60 degrees, for a plant that varies."""
    return Specification(modulus_margin=0.8, phase_margin_rad=math.radians(60.0), noise_gain=noise_gain)


@dataclass(frozen=True, kw_only=True)
class Design:
    """A controller that meets a specification, and how good it is.

    Attributes
    ----------
    kind : {"pi", "pid"}
        Structure asked for.
    controller : PIDController
        The controller.
    specification : Specification
        What was asked for.
    h2 : float
        Norm (11) with the plant that was designed on.
    h2_lower_bound : float or None
        No controller of this structure in the searched domain that meets the specification has a smaller norm; None
        where no bound was computed.
    binding : tuple of str
        Constraints that hold with equality: ``modulus margin``, ``phase margin``, ``noise gain``, ``delay margin``.
    margins : Margins
        The least over the plants that it was designed for; norm and crossover are those of the nominal one.
    certificate : str
        In a sentence, what the lower bound covers or why there is none.
    is_integral : bool
        The proportional part does nothing; K and T_I are a PI's that acts as an integral controller of K/T_I.
    """

    kind: Kind
    controller: PIDController
    specification: Specification
    h2: float
    h2_lower_bound: float | None
    binding: tuple[str, ...]
    margins: Margins
    certificate: str
    is_integral: bool = False

    @property
    def gap(self) -> float | None:
        """Relative distance between the norm and its lower bound."""
        return None if self.h2_lower_bound is None else self.h2 / self.h2_lower_bound - 1.0

    def to_json(self) -> dict[str, Any]:
        """Return the fixed form of ``design.json``."""
        c = self.controller
        return {
            "kind": self.kind,
            "K": c.K,
            "Ti_s": c.Ti_s,
            "Td_s": c.Td_s,
            "Tf_s": c.Tf_s,
            "h2": self.h2,
            "h2_lower_bound": self.h2_lower_bound,
            "binding": list(self.binding),
            "margins": self.margins.to_json(),
            "setpoint_weight": c.setpoint_weight,
            "certificate": self.certificate,
            **({"is_integral": True} if self.is_integral else {}),
        }
