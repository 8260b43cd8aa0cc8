"""Where an effect comes to what another one is by its own name."""

from __future__ import annotations

import pytest

from autotune.effects import kind_of
from autotune.effects.base import Fitted


@pytest.mark.parametrize(("damping", "is_other"), [(0.2, False), (0.9, False), (1.0, True), (3.0, True)])
def test_a_mode_that_does_not_ring_is_two_lags_by_another_name(damping: float, is_other: bool) -> None:
    stand_in = kind_of("plant.resonance").stand_in
    assert stand_in is not None
    values = {"frequency": 1.0, "damping": damping}
    assert stand_in(Fitted(values=values, travelled=1.0, noise_sd=0.01, mechanical=True)) is is_other
