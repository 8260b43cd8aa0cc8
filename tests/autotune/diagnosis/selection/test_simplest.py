"""What is chosen among hypotheses that stretches have judged: they are compared as what is material in each."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.selection.judged import ranked, simplest
from autotune.diagnosis.selection.judged_chain import JudgedChain
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

GRAVITY, DRY, CURVED, DROPPING = (
    "plant.sine_torque", "plant.coulomb_friction", "actuator.nonlinear_gain", "plant.stribeck_friction",
)  # fmt: skip
#: Errors on eight stretches, about 1.
STRETCHES = np.array([0.9, 1.1, 1.0, 0.95, 1.05, 1.02, 0.98, 1.0])


@pytest.fixture(scope="module")
def fitted() -> tuple[Data, Fit]:
    """Return a fit of a lag to a walk, which leaves more than noise: names and errors are what is compared here."""
    rng = np.random.default_rng(1)
    r = Recording(t=0.1 * np.arange(400), u=rng.normal(size=400), y=np.cumsum(rng.normal(size=400)), name="r")
    lag = Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 1.0)))
    model = Model(name="lag", input=Port(), output=Port(), blocks=(lag,))
    return prepare(model, [r], inspect([r])[0])


def test_what_is_freed_of_the_immaterial_is_compared_once_more(fitted: tuple[Data, Fit]) -> None:
    data, fit = fitted

    def one(names: tuple[str, ...], size: float, log_odds: float) -> JudgedChain:
        squares = np.square(size * STRETCHES)
        return JudgedChain(
            names=names, fit=fit, short=fit, data=data, few=data, long_squares=squares, short_squares=squares,
            log_odds=log_odds,
        )  # fmt: skip

    plain, small = one((), 3.0, 0.0), one((GRAVITY, DRY), 1.0, 0.0)
    # ahead of all by its odds, and by less than a tenth better than what is smaller
    leading, other = one((CURVED, GRAVITY, DRY), 0.92, 3.0), one((CURVED, GRAVITY, DROPPING), 0.75, -0.5)
    assert ranked([plain, small, leading, other])[0] is leading
    assert simplest([plain, small, leading, other], 0.1) is other
    assert simplest([plain, small, leading], 0.1) is small
