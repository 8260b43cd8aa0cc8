"""What a planned experiment must keep to: limits, operating point, sampling, and the present control law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autotune.config import Config
from autotune.config.procedure import LimitSettings
from autotune.controller import PIDController
from autotune.diagnosis.evidence.law import stated_law
from autotune.diagnosis.result import Diagnosis


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Where and within what an experiment is planned.

    Attributes
    ----------
    limits : LimitSettings
        Safety envelope.
    y : float
        Operating point [y unit].
    sample_time_s : float
        Step between rows [s].
    u_step : float
        Resolution of the command, 0 for any value [u unit].
    law : PIDController, optional
        The present control law; without one a command is held.
    """

    limits: LimitSettings
    y: float
    sample_time_s: float
    u_step: float = 0.0
    law: PIDController | None = None


def conditions_of(config: Config) -> Conditions:
    """Return the conditions that a rig's configuration states."""
    given = config.controller
    return Conditions(
        limits=config.limits,
        y=config.operating_point.y,
        sample_time_s=config.signals.sample_time_s,
        u_step=config.signals.u_step,
        law=None if given is None else PIDController(K=given.K, Ti_s=given.Ti_s),
    )


def is_driven(found: Diagnosis) -> bool:
    """Whether a command moved in the recordings, so that one may be planned; free decays have none."""
    return any(float(np.ptp(r.u)) > 0.0 for r in found.search.recordings)


def as_recorded(found: Diagnosis) -> Conditions:
    """Return limits, operating point and law as the recordings show them: a plan goes no further than they went."""
    recordings = found.search.recordings
    u, y = (np.concatenate([getattr(r, key) for r in recordings]) for key in ("u", "y"))
    y = y[np.isfinite(y)]
    centre = float(np.median(y))
    law = None
    for r in recordings:
        stated = stated_law(r.metadata, None)
        if stated is not None and isinstance(stated.controller, PIDController):
            law = PIDController(K=stated.controller.K, Ti_s=min(stated.controller.Ti_s, 1e9))
    limits = LimitSettings(
        u_min=float(u.min()), u_max=float(u.max()), u_safe=float(np.median(u)), y_min=float(y.min()),
        y_max=float(y.max()), swing=float(np.max(np.abs(y - centre))),
        u_rate=float(np.ptp(u)) / recordings[0].sample_time_s,
    )  # fmt: skip
    return Conditions(limits=limits, y=centre, sample_time_s=recordings[0].sample_time_s, law=law)
