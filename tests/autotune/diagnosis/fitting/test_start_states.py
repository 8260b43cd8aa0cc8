"""Start states of windows take of chi-square what noise gives them, each as far as it is felt."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from autotune.diagnosis.fitting.data import as_white
from autotune.diagnosis.fitting.fit import Fit, fit
from autotune.diagnosis.fitting.long_windows import cut
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.thresholds import IN_USE
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

DT, LAG_S, NOISE = 0.1, 0.5, 0.02


def behind(drive_s: float) -> Model:
    """Return a lag of half a second behind a drive."""
    blocks = (
        Block(name="drive", place="actuator", dynamics=TransferFunction(num=(1.0,), den=(drive_s, 1.0))),
        Block(name="speed", place="plant", dynamics=TransferFunction(num=(2.0,), den=(LAG_S, 1.0)), output="speed"),
    )
    return Model(name="motor", input=Port(), output=Port(), blocks=blocks)


def held_at_truth(model: Model, seed: int) -> Fit:
    """Return a fit of start states alone, of windows of four seconds."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=80), 10)
    drive_s = model.blocks[0].dynamics.den[0]
    rates = np.array([[-1.0 / drive_s, 0.0], [2.0 / LAG_S, -1.0 / LAG_S]])
    plant = (rates, np.array([[1.0 / drive_s], [0.0]]), np.array([[0.0, 1.0]]), np.zeros((1, 1)))
    y = dlsim(cont2discrete(plant, DT), u)[1][:, 0]
    r = Recording(t=DT * np.arange(u.size), u=u, y=y + NOISE * rng.normal(size=u.size))
    data = as_white(cut(model, [r], [np.isfinite(r.y)], 4.0, IN_USE), NOISE)
    p = parametrise(model, [], 1.0, DT)
    return fit(p, data, iterations=10, free=np.zeros(p.centre.size, dtype=bool))


def test_a_state_that_nothing_is_felt_of_is_not_paid_for() -> None:
    """A drive's lag of nanoseconds: no row shows where it began."""
    result = held_at_truth(behind(1e-9), 0)
    assert result.jacobian[1].shape[1] == 2
    assert result.free_states == pytest.approx(len(result.windows), abs=0.01)


@pytest.mark.parametrize("drive_s", [1e-9, 0.01, 0.2])
def test_noise_leaves_one_of_chi_square_less_for_each_state_that_is_felt(drive_s: float) -> None:
    fits = [held_at_truth(behind(drive_s), seed) for seed in range(30)]
    expected = np.array([one.rows - one.free_states for one in fits])
    sd = float(np.sqrt(np.mean(2.0 * expected) / len(fits)))
    assert np.mean([one.chi2 for one in fits]) == pytest.approx(float(np.mean(expected)), abs=3.0 * sd)
