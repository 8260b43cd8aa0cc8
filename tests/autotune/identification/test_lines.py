"""A command of a few sines is a test like any other: y answers it or does not, and which follows which is told."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

import autotune as at
from autotune.controller import PIDController
from autotune.errors import IdentificationError
from autotune.identification.delay.tracking import track
from autotune.identification.dependence import CHANCE, dependence
from autotune.identification.frequency.line_points import line_points
from autotune.identification.lines import find_lines, is_one_sine
from autotune.recording import Recording

T = 0.5 * np.arange(1200)
SINES = {
    "one": 0.7 * np.sin(2 * np.pi * T / 40),
    "two": 0.5 * np.sin(2 * np.pi * T / 40) + 0.4 * np.sin(2 * np.pi * T / 15),
    "three": 0.5 * np.sin(2 * np.pi * T / 40) + 0.4 * np.sin(2 * np.pi * T / 15) + 0.3 * np.sin(2 * np.pi * T / 90),
}
SINES["two, by a converter"] = np.round(SINES["two"] * 50) / 50


def noise_of(colour: str, rng: np.random.Generator) -> np.ndarray:
    white = rng.standard_normal(T.size)
    return {"white": white, "lag": lfilter([1.0], [1.0, -0.95], white), "random walk": np.cumsum(white)}[colour]


def answer(u: np.ndarray, sd: float, seed: int = 3) -> np.ndarray:
    """Return what two lags and a dead time make of a command, and white noise."""
    x = lfilter([0.05], [1.0, -0.95], np.concatenate([np.zeros(5), u[:-5]]))
    return 3.0 * lfilter([0.1], [1.0, -0.9], x) + sd * np.random.default_rng(seed).standard_normal(u.size)


@pytest.mark.parametrize("sines", SINES)
@pytest.mark.parametrize("sd", [0.01, 0.2])
def test_y_answers_sines_and_u_does_not_answer_y(sines: str, sd: float) -> None:
    found = dependence(SINES[sines], answer(SINES[sines], sd))
    assert found.answers
    assert found.backward >= CHANCE


@pytest.mark.parametrize("sines", ["two", "three"])
def test_swapped_columns_of_such_a_test_are_said(sines: str) -> None:
    """A plant's noise is in its y: a clean column cannot be what a noisy one causes."""
    swapped = Recording(t=T, u=answer(SINES[sines], 0.03), y=SINES[sines], name="test")
    with pytest.raises(IdentificationError, match="u and y seem swapped"):
        at.tune(swapped)


@pytest.mark.parametrize("colour", ["white", "lag", "random walk"])
@pytest.mark.parametrize("sines", SINES)
def test_noise_of_any_colour_answers_no_sines(sines: str, colour: str) -> None:
    rng = np.random.default_rng(7)
    found = [dependence(SINES[sines], noise_of(colour, rng)) for _ in range(12)]
    assert not any(one.answers or one.backward < CHANCE for one in found)


@pytest.mark.parametrize("proportional", [0.4, 0.0])
def test_a_controller_that_answers_a_swinging_load_says_nothing_of_the_plant(proportional: float) -> None:
    """Both columns have the load's line, and y over u there is the inverse of the controller."""
    rng = np.random.default_rng(5)
    x = z = integral = 0.0
    u, y, waiting = np.zeros(T.size), np.zeros(T.size), [0.0] * 6
    for i in range(T.size):
        y[i] = z + np.sin(2 * np.pi * i / 90) + 0.02 * rng.standard_normal()
        integral -= y[i] * 0.4 / 120
        u[i] = integral - proportional * y[i]
        waiting.append(u[i])
        x = 0.95 * x + 0.05 * waiting.pop(0)
        z = 0.9 * z + 0.3 * x
    found = dependence(u, y)
    assert not found.answers
    assert found.follows_in_row


@pytest.mark.parametrize("sines", ["two", "three", "two, by a converter"])
def test_a_controller_is_tuned_to_a_test_with_sines(sines: str) -> None:
    record = Recording(t=T, u=5.0 + SINES[sines], y=20.0 + answer(SINES[sines], 0.02), name="test")
    rng = np.random.default_rng(1)
    levels = 0.7 * np.repeat(rng.choice([-1.0, 1.0], 60), 20)
    beside = Recording(t=T, u=5.0 + levels, y=20.0 + answer(levels, 0.02), name="levels")
    tuned, usual = (at.tune(one).controller for one in (record, beside))
    assert isinstance(tuned, PIDController)
    assert isinstance(usual, PIDController)
    gains = [(one.K, one.Ti_s) for one in (tuned, usual)]
    assert gains[0] == pytest.approx(gains[1], rel=0.03)


@pytest.mark.parametrize("sd", [0.02, 0.2])
def test_every_sine_gives_a_point_whose_region_holds_the_plant(sd: float) -> None:
    """The plant is sampled: its pulse transfer function over the hold's own response is what a held command sees."""

    def response(omega: float) -> complex:
        z, half = np.exp(0.5j * omega), 0.25 * omega
        sampled = 3.0 * 0.1 / (1 - 0.9 / z) * 0.05 / (1 - 0.95 / z) * z**-5
        return complex(sampled / (np.sinc(half / np.pi) * np.exp(-1j * half)))

    distances = []
    for seed in range(40):
        points = line_points(T, SINES["three"], answer(SINES["three"], sd, seed), held=True)
        omega = [point.omega_rad_s for point in points]
        np.testing.assert_allclose(omega, 2 * np.pi / np.array([90.0, 40.0, 15.0]), rtol=1e-6)
        for point in points:
            apart = point.response - response(point.omega_rad_s)
            error = np.array([apart.real, apart.imag])
            distances.append(error @ np.linalg.solve(np.array(point.covariance), error))
    # chi-square of two degrees of freedom; 120 of them are within .95 +- .04 twice in a hundred times not
    assert 0.90 < np.mean(np.array(distances) < 5.99) < 0.995


def test_one_sine_gives_one_point_and_no_controller() -> None:
    record = Recording(t=T, u=5.0 + SINES["one"], y=20.0 + answer(SINES["one"], 0.02), name="test")
    assert len(at.frequency_points(record)) == 1
    with pytest.raises(IdentificationError, match="u is one sine"):
        at.tune(record)


def test_what_else_repeats_itself_is_no_sine() -> None:
    assert is_one_sine(SINES["one"])
    assert not is_one_sine(SINES["two"])
    rng = np.random.default_rng(2)
    for other in (np.sign(SINES["one"]), np.repeat(rng.choice([-1.0, 1.0], 60), 20), noise_of("lag", rng), T):
        assert not find_lines(other).size


def test_no_window_of_swapped_columns_is_tracked() -> None:
    """A window has too few periods to tell; the whole record has enough."""
    swapped = Recording(t=T, u=answer(SINES["three"], 0.03), y=SINES["three"], name="test")
    with pytest.raises(IdentificationError, match="u and y seem swapped"):
        list(track(swapped, 2, window_s=200.0, every_s=100.0, max_delay_s=20.0))
