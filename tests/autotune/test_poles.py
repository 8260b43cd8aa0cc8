"""The slowest lag and the slowest mode of plants whose poles are known."""

import numpy as np
import pytest

from autotune.poles import moving, slowest_lag_s, slowest_mode_s


@pytest.mark.parametrize(
    ("poles", "lag_s", "mode_s"),
    [
        ([-0.5, -10.0], 2.0, 2.0),
        ([0.0, -0.25, -4.0], 4.0, 4.0),
        ([-0.1 + 2.0j, -0.1 - 2.0j], 10.0, 1.0 / abs(-0.1 + 2.0j)),  # rings: settles in 10 s, swings at 2 rad/s
        ([2.0j, -2.0j, -8.0], 0.125, 0.5),  # an undamped pair has no time constant
        ([3.0, -1.0 / 7.0], 7.0, 7.0),  # a pole on the right grows within its own
        ([0.0], 0.0, 0.0),
        ([], 0.0, 0.0),
    ],
)
def test_integrators_are_left_aside(poles, lag_s, mode_s):
    assert slowest_lag_s(np.array(poles)) == pytest.approx(lag_s, rel=1e-14)
    assert slowest_mode_s(np.array(poles)) == pytest.approx(mode_s, rel=1e-14)


def test_an_integrator_that_rounding_moved_is_none():
    chain = np.diag([0.0, -1.0 / 3600.0, -300.0])
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    poles = np.linalg.eigvals(turn @ chain @ turn.T)
    assert moving(poles).size == 2
    assert slowest_lag_s(poles) == pytest.approx(3600.0, rel=1e-6)
