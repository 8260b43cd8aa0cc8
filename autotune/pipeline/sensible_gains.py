"""What is asked of gains before a rig's own controller gets them, whether they are tried on it afterwards or not."""

from __future__ import annotations

from autotune.config import Config
from autotune.config.gains import beyond_ranges
from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.experiment.judgement import require_predictable
from autotune.identification.parametric import PlantFit


def require_sensible(config: Config, old: PIDController, new: PIDController, fit: PlantFit | None) -> None:
    """Refuse gains that the rig's ranges, its measured plant, or the gains that it holds speak against.

    Parameters
    ----------
    config : Config
        Of the rig.
    old, new : PIDController
        Gains that the rig's own controller holds, and those that it is to hold.
    fit : PlantFit or None
        The rig's measured plant; None where nothing is known of it.

    Raises
    ------
    InputError
        Gains that no rig of these ranges runs with; or of a sign that neither the configuration nor the rig's own
        controller has, where no measured plant says that it is right.
    DesignError
        The loop would be unstable on the measured plant, or on one that its points allow.
    """
    gains = f"K = {new.K:.4g}, T_I = {new.Ti_s:.4g} s"
    odd = beyond_ranges(new.K, new.Ti_s, config.limits, config.signals.sample_time_s)
    if odd is not None:
        raise _refusal(odd, "check the units of the gains, limits.u_min to u_max and limits.y_min to y_max")
    if fit is not None:
        require_predictable(fit, new)
        return
    known = config.operating_point.plant_sign
    if known and known * new.K < 0.0:
        raise _refusal(f"{gains} have the wrong sign: operating_point.plant_sign = {known}", "correct one of the two")
    if not known and old.K * new.K < 0.0:
        raise _refusal(
            f"{gains} have the other sign than the K = {old.K:.4g} that the rig holds: one of the two runs away",
            "give --run DIR or --points P.json, which say what sign the plant has, or operating_point.plant_sign",
        )


def _refusal(what: str, remedy: str) -> InputError:
    return InputError(what, where="gains", remedy=f"nothing was written; {remedy}")
