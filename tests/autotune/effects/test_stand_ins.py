"""Where an effect comes to what another one is by its own name."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.diagnosis.simulation.forecast import forecast
from autotune.effects import counted_as, kind_of
from autotune.effects.base import Fitted
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording


@pytest.mark.parametrize(("damping", "is_other"), [(0.2, False), (0.9, False), (1.0, True), (3.0, True)])
def test_a_mode_that_does_not_ring_is_two_lags_by_another_name(damping: float, is_other: bool) -> None:
    stand_in = kind_of("plant.resonance").stand_in
    assert stand_in is not None
    values = {"frequency": 1.0, "damping": damping}
    assert stand_in(Fitted(values=values, travelled=1.0, noise_sd=0.01, mechanical=True)) is is_other


def test_a_hysteresis_that_turns_at_once_is_dry_friction_and_is_counted_as_such() -> None:
    """Dahl: the nearer the width comes to 0, the nearer the force comes to Coulomb's."""
    arm = Block(name="arm", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.3, 9.0)))
    t = 0.02 * np.arange(1000)
    recording = Recording(t=t, u=4.0 * np.sin(1.3 * t) + 3.0 * np.sin(4.1 * t), y=np.zeros(t.size))

    def moved(name: str, **values: float) -> np.ndarray:
        effect = Effect(name=name, parameters={key: Parameter(value=value) for key, value in values.items()})
        model = Model(name="arm", input=Port(), output=Port(), blocks=(arm,), effects=(effect,))
        return forecast(model, recording)[200:]

    dry = moved("plant.coulomb_friction", level=0.5)
    off = [float(np.std(moved("plant.hysteresis", amplitude=0.5, width=w) - dry)) for w in (0.5, 0.05, 0.005)]
    assert off == sorted(off, reverse=True)
    assert off[-1] < 0.02 * float(np.std(dry))
    assert "plant.hysteresis" in counted_as("plant.coulomb_friction")
