"""What is named beside a leading effect: more probable than not naming it, whatever the search added."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.diagnosis.equations.bench import Outcome
from autotune.diagnosis.equations.probable import without_improbable
from autotune.diagnosis.equations.search import Searched
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.thresholds import IN_USE
from autotune.equations import compile_model
from autotune.equations.fit import fit
from autotune.models import Effect, Parameter
from autotune.recording import Recording
from tests.autotune.equations.models import one_state

ROWS = 400
T = 0.1 * np.arange(ROWS)
FITTED = fit(compile_model(one_state("u - x")), [Recording(t=T, u=np.zeros(ROWS), y=np.zeros(ROWS))], iterations=1)


def left(sd: float, count: int, *names: str) -> Outcome:
    """Return a hypothesis that leaves noise of a standard deviation."""
    effects = tuple(Effect(name=n, parameters={"level": Parameter(value=1.0)}, state="x") for n in names)
    residual = sd * np.where(np.arange(ROWS) % 2, 1.0, -1.0)
    return Outcome(effects=effects, fitted=FITTED, count=count, residual=residual)


@pytest.mark.parametrize(
    ("load", "named"),
    [(1.101, {"plant.coulomb_friction"}), (1.29, {"plant.coulomb_friction", "plant.sine_torque"})],
)
def test_one_of_several_explanations_of_a_small_rest_is_not_told_from_the_others(load: float, named: set[str]) -> None:
    """Friction takes most; a torque takes the rest, and a load as much of it (1.10) or next to none (1.29)."""
    friction = left(1.3, 2, "plant.coulomb_friction")
    both = left(1.1, 5, "plant.coulomb_friction", "plant.sine_torque")
    others = [left(load, 3, "plant.coulomb_friction", "environment.step_load")]
    found = Searched(
        nominal=left(40.0, 1), retuned=left(30.0, 1), chosen=both, tried=(friction, both, *others),
        noise=Noise(sd=1.0), rows=float(ROWS), limits=IN_USE,
    )  # fmt: skip
    assert {e.name for e in without_improbable(found).chosen.effects} == named
