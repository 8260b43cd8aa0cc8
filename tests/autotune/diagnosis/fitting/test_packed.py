"""Some windows of a recording, packed: the same fit as with all rows carried along, whatever acted before a window."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from autotune.diagnosis.evidence.residual import FreedResidual
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import fit, states_of
from autotune.diagnosis.fitting.noise import Noise
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.fitting.retuning import reduced_chi2
from autotune.diagnosis.fitting.spreading import spread_out
from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.simulation.simulator import Windows
from autotune.models import Block, Effect, Model, Parameter, Place, Port, TransferFunction
from autotune.recording import Recording

ROWS, WINDOW = 2000, 100
#: A play remembers commands before a window, a dead time waits for one, a load acts at a time of its own, and the
#: recording's clock is wrong.
EFFECTS = {
    "actuator.backlash": {"width": 0.3},
    "timing.dead_time": {"delay": 0.17},
    "environment.step_load": {"amplitude": 0.2, "time": 51.0, "end": 190.0},
    "timing.clock_error": {"error": 0.004},
}


def model(*effects: Effect) -> Model:
    block = Block(name="plant", place="plant", dynamics=TransferFunction(num=(1.0,), den=(2.0, 1.0)))
    return Model(name="lag", blocks=(block,), input=Port(unit="V"), output=Port(unit="V"), effects=effects)


def effect_of(name: str) -> Effect:
    values = {key: Parameter(value=value) for key, value in EFFECTS[name].items()}
    return Effect(name=name, parameters=MappingProxyType(values))


def some_windows(effect: Effect, seed: int) -> Data:
    """Every third window, and two neighbours, of two recordings of a plant with an effect."""
    rng = np.random.default_rng(seed)
    recordings = []
    for number in range(2):
        t = 0.1 * np.arange(ROWS)
        u = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 25), 25)
        sim = assemble(model(effect))
        y = sim.run(Recording(t=t, u=u, y=0.0 * t), np.zeros(1), number=number)[0][:, 0]
        recordings.append(Recording(t=t, u=u, y=y + 0.01 * rng.standard_normal(ROWS)))
    starts = np.arange(0, ROWS, WINDOW)
    data = Data(
        recordings=tuple(recordings),
        good=tuple(rng.uniform(size=ROWS) > 0.01 for _ in recordings),
        starts=(starts, starts),
        stops=(starts + WINDOW, starts + WINDOW),
        noise=Noise(sd=0.01, ar=(0.2,)),
    )
    keep = np.isin(np.arange(starts.size), (1, 4, 7, 8, 10, 13, 19))
    return data.only((keep, keep))


@pytest.mark.parametrize("name", EFFECTS)
def test_a_fit_to_packed_rows_is_the_fit_to_those_rows_in_their_recordings(name: str) -> None:
    packed = some_windows(effect_of(name), 5)
    whole = packed.spread_out()
    assert sum(map(len, packed.recordings)) < 0.5 * sum(map(len, whole.recordings))
    assert packed.rows == whole.rows
    p = parametrise(model(), [effect_of(name)], 1.0, 0.1)
    small, large = fit(p, packed), fit(p, whole)
    np.testing.assert_allclose(small.theta, large.theta, rtol=1e-6, atol=1e-9)
    assert small.chi2 == pytest.approx(large.chi2, rel=1e-9)
    assert reduced_chi2(small, packed) == pytest.approx(reduced_chi2(large, whole), rel=1e-6)
    spread, same = spread_out(small, packed)
    assert [len(r) for r in same.recordings] == [ROWS, ROWS]
    assert spread.windows == large.windows
    for one, other in zip(spread.signals + spread.whitened, large.signals + large.whitened, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(spread.jacobian[0], large.jacobian[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("place", ["actuator", "plant", "sensor"])
def test_a_missing_signal_shows_in_packed_rows_as_in_those_rows_of_their_recordings(place: Place) -> None:
    packed = some_windows(effect_of("environment.step_load"), 5)
    assert packed.whole is not None
    packed = replace(packed, noise=Noise(sd=0.01), whole=replace(packed.whole, noise=Noise(sd=0.01)))
    whole = packed.spread_out()
    p = parametrise(model(), [], 1.0, 0.1)
    shown = []
    for data in (packed, whole):
        left = FreedResidual(fit(p, data), data)
        shown.append(left.shown(place, [np.sin(0.3 * r.t) * r.u for r in data.recordings]))
    rows = np.concatenate([np.arange(ROWS)[k] + number * ROWS for number, k in enumerate(packed.kept)])
    np.testing.assert_allclose(shown[0], shown[1][rows], atol=1e-3 * float(np.max(np.abs(shown[1]))))
    assert np.count_nonzero(shown[1]) <= packed.rows


def test_a_window_beyond_a_recording_is_refused_before_it_is_read() -> None:
    recording = Recording(t=np.arange(10.0), u=np.zeros(10), y=np.zeros(10))
    beyond = Windows(starts=np.array([0]), stops=np.array([11]))
    with pytest.raises(ValueError, match="row 11 of 10"):
        assemble(model()).run(recording, np.zeros(1), beyond)


def test_start_states_are_known_by_the_rows_of_the_whole_recordings() -> None:
    packed = some_windows(effect_of("timing.dead_time"), 7)
    result = fit(parametrise(model(), [], 1.0, 0.1), packed, iterations=2)
    fewer = packed.only([np.array([0, 3]), np.array([2, 5])])
    for x0, known, number in zip(states_of(result, fewer), result.x0, ((0, 3), (2, 5)), strict=True):
        np.testing.assert_array_equal(x0, known[list(number)])


@pytest.mark.parametrize("packed", [True, False])
def test_a_fit_to_two_divisions_counts_each_by_its_own_noise(packed: bool) -> None:
    effect = effect_of("environment.step_load")
    some = some_windows(effect, 9)
    assert some.whole is not None
    every_other = np.arange(10) % 2 == 0
    pairs = replace(
        some.whole, starts=tuple(a[::2] for a in some.whole.starts), stops=tuple(b[1::2] for b in some.whole.stops)
    )
    long = replace(pairs.only((every_other, every_other)), noise=Noise(sd=0.03))
    short = replace(some, noise=Noise(sd=0.01))
    both = long.beside(short) if packed else long.beside(short.spread_out())
    assert (both.whole is not None) == packed
    p = parametrise(model(), [effect], 1.0, 0.1)
    held = np.zeros(len(p.free), dtype=bool)
    theta = fit(p, short).theta
    apart = [fit(p, data, theta, free=held) for data in (long, short)]
    joint = fit(p, both, theta, free=held)
    assert joint.chi2 == pytest.approx(sum(each.chi2 for each in apart), rel=1e-6)
    assert fit(p, both, theta).chi2 < joint.chi2
