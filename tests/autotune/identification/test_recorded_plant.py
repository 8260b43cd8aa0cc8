"""Plants fitted to plain recordings: their regions hold what the record leaves possible, and little else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from autotune.arrays import FloatArray
from autotune.identification.delay.identify import identify_delay
from autotune.identification.recorded_plant import fit_recordings
from autotune.models import TransferFunction
from autotune.recording import Recording

#: when the command moves [s], and by how much
BUMPS = ((300.0, 5.0), (700.0, -5.0), (1100.0, -5.0), (1500.0, 5.0))
NOISE = 0.05
T = np.arange(1900.0)
OMEGA = np.geomspace(0.01, 0.3, 8)
#: a small lag beside a dead time: the record determines their sum
PLANT = TransferFunction(num=(0.8,), den=tuple(np.polymul([90.0, 1.0], [6.0, 1.0])), delay_s=16.0)


def answer(plant: TransferFunction) -> FloatArray:
    """Response of a plant with two real poles, or one, to the bumps, exact at every row."""
    poles = plant.poles
    gain = plant.num[-1] / plant.den[-1]
    shares = [np.prod([q / (q - p) for j, q in enumerate(poles) if j != i]) for i, p in enumerate(poles)]
    y = np.zeros(T.size)
    for at, size in BUMPS:
        since = np.maximum(T - at - plant.delay_s, 0.0)
        modes = sum(share * np.exp(pole * since) for share, pole in zip(shares, poles, strict=True))
        y += size * gain * np.real(1.0 - modes)
    return np.asarray(y, dtype=np.float64)


def recorded(seed: int) -> Recording:
    """The plant under the bumps, with white noise."""
    u = np.sum([np.where(at <= T, size, 0.0) for at, size in BUMPS], axis=0)
    y = answer(PLANT) + NOISE * np.random.default_rng(seed).standard_normal(T.size)
    return Recording(t=T, u=u, y=y, name="two lags")


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_region_is_no_wider_than_the_record_where_a_controller_works(seed: int) -> None:
    recording = recorded(seed)
    y, fit = recording.y, fit_recordings([recording])
    assert fit.parameters.size == 4
    plants = fit.border(float(np.sqrt(chi2.ppf(0.95, fit.parameters.size))))

    def deviance(plant: TransferFunction) -> float:
        error = y - answer(plant)
        return float(np.sum((error - np.mean(error)) ** 2)) / NOISE**2

    # a fast lag may be anything near its estimate, but then the dead time is what their sum, which is known, leaves
    of_two = [plant for plant in plants if plant.poles.size == 2]  # one lag with a longer dead time may be left too
    lags = np.array([1.0 / np.max(-plant.poles.real) for plant in of_two])
    sums = lags + np.array([plant.delay_s for plant in of_two])
    assert np.ptp(sums) < 0.5 * np.ptp(lags)
    omega = np.array([0.03])  # crossover of a PI for this plant
    turned = [float(np.angle(plant.response(omega) / fit.plant.response(omega), deg=True)[0]) for plant in plants]
    assert np.max(np.abs(turned)) < 2.5
    worst = max(deviance(plant) for plant in plants) - deviance(fit.plant)
    assert worst < 20.0 * chi2.ppf(0.95, 4)  # the region is of first order; beyond that only its shape is wrong


def long_recording() -> Recording:
    """Lags of 12 and 4 rows behind a dead time of 5, steps of u every 22 rows: 60,000 of them."""
    rng, rows = np.random.default_rng(4), 60_000
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 22 + 1), 22)[:rows]
    poles = np.exp([-1.0 / 12.0, -1.0 / 4.0])
    slow, fast = (lfilter([0.0, 1.0 - pole], [1.0, -pole], u) for pole in poles)  # exact, as u is held
    y = np.concatenate([np.zeros(5), (3.0 * slow - fast)[:-5]]) + 0.1 * rng.standard_normal(rows)
    return Recording(t=np.arange(float(rows)), u=u, y=y, name="long")


def test_of_a_long_record_all_rows_count() -> None:
    """One row in three chooses the structure, and all are fitted with it."""
    fit, model = fit_recordings([long_recording()]), identify_delay(long_recording(), 2)
    truth = [-1.0 / 48.0, -(1.0 / 12.0 + 1.0 / 4.0), 2.0 / 48.0, 5.0]
    assert fit.plant.poles.size == 2
    assert np.all(np.abs((np.array([*model.a, model.b, model.delay_s]) - truth) / model.standard_deviations[:4]) < 4.0)
    np.testing.assert_allclose(fit.plant.response(OMEGA), model.transfer_function().response(OMEGA), rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(fit.covariance[-1, -1]), model.standard_deviations[3], rtol=0.1)


def test_one_row_in_eleven_finds_what_all_rows_determine() -> None:
    """u moves between the rows of y that are left, and its response is exact at them all the same."""
    few = identify_delay(long_recording(), 2, every=11)
    assert few.rows <= 60_000 / 11 + 1
    np.testing.assert_allclose([*few.a, few.b, few.delay_s], [-1 / 48, -1 / 3, 2 / 48, 5.0], rtol=0.1)


@pytest.mark.parametrize(("slower", "smaller"), [(600.0, 1e-4), (1e-4, 1e4)])
def test_units_of_time_and_of_the_measurement_change_neither_plant_nor_region(slower: float, smaller: float) -> None:
    recording = recorded(0)
    other = Recording(t=slower * T, u=recording.u, y=smaller * recording.y, name="the same in other units")
    omega = np.geomspace(1e-3, 0.1, 20)

    def responses(of: Recording, per_s: float, per_y: float) -> tuple[FloatArray, FloatArray]:
        fit = fit_recordings([of])
        drawn = [plant.response(omega / per_s) / per_y for plant in fit.draws(400, np.random.default_rng(0))]
        plant = fit.plant.response(omega / per_s) / per_y
        return plant, np.std(np.abs(np.array(drawn) / plant), axis=0)

    plant, scatter = responses(recording, 1.0, 1.0)
    scaled, scaled_scatter = responses(other, slower, smaller)
    np.testing.assert_allclose(scaled, plant, rtol=1e-3)
    np.testing.assert_allclose(scaled_scatter, scatter, rtol=0.25)


def test_parameters_say_the_same_plant_over_any_coefficient() -> None:
    recording = recorded(0)
    fit, model = fit_recordings([recording]), identify_delay(recording, 2)
    omega = np.geomspace(1e-3, 1.0, 30)
    np.testing.assert_allclose(fit.plant.response(omega), model.transfer_function().response(omega), rtol=1e-6)
    # a change of parameters moves the scatter of no frequency response: both covariances give the same, to first order
    for one in (omega[10], omega[20]):
        spread = [
            _spread(
                lambda x, one=one: complex(fit.build(x).response(np.array([one]))[0]), fit.parameters, fit.covariance
            ),
            _spread(
                lambda x, one=one: complex(_plant(x).response(np.array([one]))[0]),
                model.values[:4],
                model.covariance[:4, :4],
            ),
        ]
        np.testing.assert_allclose(spread[0], spread[1], rtol=1e-4)


def _plant(x: FloatArray) -> TransferFunction:
    return TransferFunction(num=(x[2],), den=(1.0, -x[1], -x[0]), delay_s=x[3])


def _spread(f: Callable[[FloatArray], complex], x: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance of (re, im) of f to first order, by central differences."""
    steps = 1e-4 * np.sqrt(np.diag(covariance))
    columns = [(f(x + step) - f(x - step)) / (2.0 * size) for step, size in zip(np.diag(steps), steps, strict=True)]
    J = np.array([[value.real for value in columns], [value.imag for value in columns]])
    return np.asarray(J @ covariance @ J.T, dtype=np.float64)
