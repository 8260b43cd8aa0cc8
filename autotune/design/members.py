"""Several plants that one controller must suit: their slacks, the worst of them, the figures that all of them have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.design.figures import Figures, columns
from autotune.design.kernels import SampledPlant, evaluate_grid, sampled_plant
from autotune.design.margins import Margins
from autotune.design.specification import Specification
from autotune.models import TransferFunction

#: delay margin [s] from which on the kernels mean that there is no crossover
_NEVER = 1e299


@dataclass(frozen=True, kw_only=True, eq=False)
class Members:
    """Plants, each on its own grid of frequencies.

    Attributes
    ----------
    plants : tuple of TransferFunction
        Exact.
    sampled : tuple of SampledPlant
        The same on their grids.
    """

    plants: tuple[TransferFunction, ...]
    sampled: tuple[SampledPlant, ...]

    def figures(self, controller: PIDController) -> Figures:
        """Return the figures of the controller on every plant, each an (S,) array; modulus negative where unstable."""
        rows = []
        for s in self.sampled:
            grid = np.array([[controller.K * s.sign, controller.Ti_s, controller.Td_s, controller.Tf_s]])
            rows.append(evaluate_grid(s.omega, s.h, s.weights, s.turn, grid, -1.0)[0])
        return columns(np.array(rows).reshape(-1, 6))

    def slacks(self, controller: PIDController, specification: Specification) -> FloatArray:
        """Return (S, 3) slacks of modulus, phase and delay margin of one controller on the plants.

        Parameters
        ----------
        controller : PIDController
            One for all S plants.
        specification : Specification
            What was asked for.
        """
        return np.asarray(specification.slacks(self.figures(controller))[:, [0, 1, 3]])

    def chosen(self, which: Sequence[int]) -> Members:
        """Return some of them."""
        return Members(plants=tuple(self.plants[i] for i in which), sampled=tuple(self.sampled[i] for i in which))

    def least(self, m: Margins, controller: PIDController) -> Margins:
        """Return margins that none of the plants falls below, nor ``m`` itself; norm and crossover are those of ``m``.

        The gain margins are found on the grids, between whose frequencies L is taken as straight.

        Parameters
        ----------
        m : Margins
            Of the nominal plant.
        controller : PIDController
            The one they belong to.
        """
        if not self.plants:
            return m
        f = self.figures(controller)
        gains = [_gain_margins(s, controller) for s in self.sampled]
        delay = float(np.min(f.delay_s))
        modulus = min(m.modulus if m.stable else -m.modulus, float(np.min(f.modulus)))
        loudest = max(m.noise_gain_bound * m.modulus, float(np.max(f.controller_gain)))
        return replace(
            m,
            stable=modulus > 0.0,
            modulus=abs(modulus),
            phase_rad=min(m.phase_rad, float(np.min(f.phase_rad))),
            delay_s=min(m.delay_s, delay if delay < _NEVER else math.inf),
            gain=min(m.gain, *(up for up, _ in gains)),
            gain_reduction=max(m.gain_reduction, *(down for _, down in gains)),
            noise_gain=max(m.noise_gain, float(np.max(f.noise_gain))),
            noise_gain_bound=loudest / abs(modulus) if modulus else math.inf,
        )


def members_of(plants: Sequence[TransferFunction], specification: Specification) -> Members:
    """Return plants with their grids, which reach as far as the specification's largest gain makes them matter.

    Parameters
    ----------
    plants : sequence of TransferFunction
        S plants.
    specification : Specification
        Its largest gain sets how far the grids reach.
    """
    sampled = tuple(sampled_plant(one, specification.largest_gain) for one in plants)
    return Members(plants=tuple(plants), sampled=sampled)


def _gain_margins(plant: SampledPlant, controller: PIDController) -> tuple[float, float]:
    """Return the smallest factor above 1 and the largest below 1 at which L meets -1; infinite and 0 where none."""
    L = plant.h * plant.sign * controller.response(plant.omega)
    here, there = L[:-1], L[1:]
    crossed = np.flatnonzero(np.sign(here.imag) * np.sign(there.imag) < 0.0)
    a, b = here[crossed], there[crossed]
    real = a.real - a.imag * (b.real - a.real) / (b.imag - a.imag)
    factors = -1.0 / real[real < 0.0]
    up, down = factors[factors > 1.0], factors[factors <= 1.0]
    return float(np.min(up, initial=np.inf)), float(np.max(down, initial=0.0))


def crossovers(plant: SampledPlant, controller: PIDController) -> FloatArray:
    """Return the frequencies [rad/s] at which abs(L) passes 1, between those of the plant's grid in log-log.

    Parameters
    ----------
    plant : SampledPlant
        On its grid.
    controller : PIDController
        L is their product.
    """
    gain = np.log(np.maximum(np.abs(plant.h * controller.response(plant.omega)), 1e-300))
    passed = np.flatnonzero(np.sign(gain[:-1]) * np.sign(gain[1:]) < 0.0)
    a, b, x = gain[passed], gain[passed + 1], np.log(plant.omega)
    return np.asarray(np.exp(x[passed] - a * (x[passed + 1] - x[passed]) / (b - a)))
