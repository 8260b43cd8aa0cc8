"""Waves of all frequencies in one pass explain what each explains by itself."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence import swings
from autotune.diagnosis.evidence.residual import FreedResidual
from autotune.diagnosis.evidence.swings import Swinging, explained_by_swings
from autotune.diagnosis.fitting.retuning import prepare
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

COUNT = 12


def recorded(seed: int) -> FreedResidual:
    """What a lag with dead time leaves of two recordings of coloured noise, some rows not counted."""
    rng = np.random.default_rng(seed)
    dynamics = TransferFunction(num=(1.0,), den=(0.5, 1.0), delay_s=0.13)
    block = Block(name="plant", place="plant", dynamics=dynamics)
    model = Model(name="lag", blocks=(block,), input=Port(unit="V"), output=Port(unit="V"))
    recordings, good = [], []
    for rows in (700, 500):
        t = 0.05 * np.arange(rows)
        u = np.repeat(rng.choice([-1.0, 1.0], rows // 20), 20)
        recordings.append(Recording(t=t, u=u, y=np.convolve(rng.standard_normal(rows), [0.1, 0.05, 0.02], "same")))
        good.append(rng.uniform(size=rows) > 0.02)
    data, result = prepare(model, recordings, good)
    return FreedResidual(result, data)


def one_by_one(left: FreedResidual, e: FloatArray, one: Swinging, cycles: int) -> float:
    """The decrease by the definition: both columns whole, the numbers' directions taken out, least squares."""
    longest = max(r.duration_s for r in left.data.recordings)
    columns = []
    for wave in (np.cos, np.sin) if cycles else (np.cos,):
        angles = [2.0 * np.pi * cycles / longest * (r.t - r.t[0]) for r in left.data.recordings]
        columns.append(left.shown(one.place, [s * wave(a) for s, a in zip(one.signals, angles, strict=True)]))
    X = left.beyond_numbers(np.column_stack(columns))
    return float(e @ e - np.sum((e - X @ np.linalg.lstsq(X, e)[0]) ** 2))


@pytest.mark.parametrize("at_once", [swings.AT_ONCE, 2000])
def test_all_at_once_is_one_by_one(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(swings, "AT_ONCE", at_once)
    left = recorded(3)
    e = left.beyond_numbers(left.e)
    signals = [np.sin(0.3 * r.t) + r.u for r in left.data.recordings]
    swinging = [Swinging(place=place, signals=signals) for place in ("actuator", "plant", "sensor")]
    found = explained_by_swings(left, e, swinging, COUNT)
    wanted = [[one_by_one(left, e, one, k) for k in range(COUNT + 1)] for one in swinging]
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-9 * float(e @ e))


def test_what_the_models_own_numbers_can_imitate_explains_nothing() -> None:
    left = recorded(4)
    e = left.beyond_numbers(left.e)
    # at no cycles the command is what the gain multiplies
    command = [r.u - left.result.sim.u_offset for r in left.data.recordings]
    found = explained_by_swings(left, e, [Swinging(place="actuator", signals=command)], COUNT)[0]
    assert found[0] == 0.0
    assert np.all(found[1:] > 0.0)
