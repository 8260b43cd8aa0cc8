"""A hypothesis: effects with the fit that has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.retuning import under_noise
from autotune.effects import kind_of
from autotune.effects.base import Fitted


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """Effects with the fit that has them; none for the retuned nominal structure."""

    names: tuple[str, ...]
    fit: Fit

    @property
    def parameters(self) -> int:
        """Free numbers beyond those of the nominal structure, those that a direct search sets included."""
        return self.fit.parametrisation.effect_numbers

    @property
    def penalised_chi2(self) -> float:
        """The cost with what free numbers have to pay: ln N each of the effects', 1 each start state.

        A block that an effect adds brings start states to every window, each of which takes 1 of chi2 from noise alone.
        """
        return float(self.fit.cost + self.parameters * np.log(self.fit.rows) + self.fit.free_states)


def hypothesis(fit: Fit) -> Hypothesis:
    """Return a fit as a hypothesis, named after the effects that its model has beyond the nominal one's."""
    return Hypothesis(names=tuple(e.name for e in fit.parametrisation.added), fit=fit)


def is_stand_in(h: Hypothesis, data: Data) -> bool:
    """Whether the fitted numbers make one of its effects the same as a simpler one."""
    added = h.fit.model.effects[h.fit.parametrisation.own :]
    able = [(e, kind_of(e.name)) for e in added if kind_of(e.name).stand_in is not None]
    if not able:
        return False
    positions = np.concatenate([signals[:, 2] for signals in h.fit.signals])
    travelled = float(np.nanmax(positions) - np.nanmin(positions))
    noise_sd = under_noise(h.fit, data).noise.total_sd  # a fit's unit may be model error, much beside what is noise
    for effect, kind in able:
        fitted = Fitted(
            values=effect.values, travelled=travelled, noise_sd=noise_sd,
            mechanical=h.fit.sim.chain.is_mechanical,
        )  # fmt: skip
        if kind.stand_in is not None and kind.stand_in(fitted):
            return True
    return False


def contradicted_effects(h: Hypothesis, data: Data) -> frozenset[str]:
    """Return its effects that would hold readings still where these scatter on.

    Notes
    -----
    Squared differences of neighbouring readings where the simulated one stands still are compared with those of the
    residual elsewhere; the share must be beyond ``majority`` by two standard deviations. A limit in front of most
    of the noise (a transmitter at its end, read through a noisy line) looks the same: ask only where a rig's noise is
    known to be in front of it, or where model error rules and a limit may stand for what it is not.
    """
    able = frozenset(name for name in h.names if kind_of(name).flattens)
    if not able:
        return able
    held, moving = [np.zeros(0)], [np.zeros(0)]
    for r, signals, good in zip(data.recordings, h.fit.signals, data.good, strict=True):
        simulated = signals[:, 0]
        both, still = good[1:] & good[:-1], np.diff(simulated) == 0.0
        held.append(np.diff(r.y)[both & still] ** 2)
        moving.append(np.diff(r.y - simulated)[both & ~still] ** 2)
    at, elsewhere = (found[np.isfinite(found)] for found in (np.concatenate(held), np.concatenate(moving)))
    if not at.size or not elsewhere.size:
        return frozenset()
    surely = (1.0 - 2.0 * np.sqrt(2.0 / at.size)) * np.mean(at)
    return able if surely > data.thresholds.majority * np.mean(elsewhere) else frozenset()
