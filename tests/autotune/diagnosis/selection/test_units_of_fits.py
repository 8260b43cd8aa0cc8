"""In what units a hypothesis is fitted: at the residual that it leaves, far below the retuned model's or not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.effects import ALL
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

NOISE, LIMIT, GAIN = 0.02, 0.15, 3.0
OTHERS = [kind.name for kind in ALL if kind.name != "actuator.saturation"]


def limited(rows: int = 800) -> Recording:
    """A lag of 12 s behind a command that is limited to +-0.15; its gain is three times what the model says."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.normal(size=rows // 8), 8)
    y, state = np.empty(rows), 0.0
    for k in range(rows):
        y[k] = state
        state += (1.0 - math.exp(-1.0 / 12.0)) * (GAIN * np.clip(u[k], -LIMIT, LIMIT) - state)
    return Recording(t=np.arange(float(rows)), u=u, y=y + NOISE * rng.normal(size=rows))


def lag(gain: float) -> Model:
    dynamics = TransferFunction(num=(gain,), den=(12.0, 1.0))
    return Model(
        name="lag", input=Port(), output=Port(), blocks=(Block(name="p", place="plant", dynamics=dynamics),)
    )  # fmt: skip


def good(recording: Recording):
    return [np.ones(len(recording), dtype=bool)]


def test_numbers_that_are_far_off_do_not_hold_an_effect_back_that_leaves_noise():
    recording = limited()
    whole = search_chain(lag(1.0), [recording], good(recording), left_out=OTHERS).chosen
    (effect,) = whole.added
    assert [effect.values["low"], effect.values["high"]] == pytest.approx([-LIMIT, LIMIT], rel=0.05)
    assert whole.leaves_noise
    assert whole.error * np.std(recording.y) == pytest.approx(NOISE, rel=0.1)
    # on a part of the rows it begins where it was, however little the model's own numbers explain there
    part = recording.read_from(160)
    readings = [np.isfinite(part.y)]
    found = search_chain(lag(1.0), [part], readings, known=[whole])
    assert found.chosen.names == whole.names
    assert found.chosen.error * np.nanstd(part.y) == pytest.approx(NOISE, rel=0.1)
