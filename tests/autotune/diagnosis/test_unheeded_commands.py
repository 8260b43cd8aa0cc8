"""What follows y whatever the command does explains nothing: a slow lag goes with any walk from where it begins."""

from __future__ import annotations

import numpy as np
import pytest

from autotune.diagnosis import diagnose
from autotune.diagnosis.equations.evidence import bench_of
from autotune.diagnosis.evidence.stretches import error_beside_still
from autotune.diagnosis.fitting.fit import fit
from autotune.diagnosis.fitting.long_windows import cut
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.diagnosis.thresholds import IN_USE
from autotune.equations.black_box import from_function
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording
from tests.autotune.equations.models import one_state
from tests.benchmarks.surrogates import NOMINAL, surrogate

ROWS, DT, SLOW_S = 800, 0.1, 50.0
COMMANDS = np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, ROWS // 20), 20)


def answering(u: np.ndarray, lag_s: float = 1.0) -> Recording:
    """What a lag of gain 1 reads."""
    y, x, kept = np.zeros(ROWS), 0.0, np.exp(-DT / lag_s)
    for k in range(ROWS):
        y[k] = x
        x = kept * x + (1.0 - kept) * u[k]
    return Recording(t=DT * np.arange(ROWS), u=u, y=y + 0.01 * np.random.default_rng(2).standard_normal(ROWS))


def walking(u: np.ndarray) -> Recording:
    """A reading that walks, and that no command moved."""
    return Recording(t=DT * np.arange(ROWS), u=u, y=np.cumsum(np.random.default_rng(3).standard_normal(ROWS)))


def of_chain(recording: Recording, lag_s: float) -> float | None:
    block = Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(lag_s, 1.0)))
    model = Model(name="lag", input=Port(), output=Port(), blocks=(block,))
    data = cut(model, [recording], [np.ones(ROWS, dtype=bool)], recording.duration_s, IN_USE)
    return error_beside_still(fit(parametrise(model, [], 1.0, DT), data), data)


def of_equations(recording: Recording, lag_s: float) -> float | None:
    bench = bench_of(one_state("(K*u - x)/T", {"K": 1.0, "T": lag_s}), [recording], [np.ones(ROWS, dtype=bool)], IN_USE)
    return bench.error_beside_still(bench.retuned())


def of_closed_model(recording: Recording, lag_s: float) -> float | None:
    def step(x: float, inputs: np.ndarray, p: dict[str, float], dt: float) -> tuple[float, float]:
        kept = np.exp(-dt / p["T"])
        return kept * x + (1.0 - kept) * p["K"] * inputs[0], x

    box = from_function(step, 0.0, {"K": 1.0, "T": lag_s})
    bench = bench_of(box, [recording], [np.ones(ROWS, dtype=bool)], IN_USE)
    return bench.error_beside_still(bench.retuned())


@pytest.mark.parametrize("share_of", [of_chain, of_equations, of_closed_model])
class TestStretchesWithCommandsThatStandStill:
    def test_a_plant_that_answers_them_errs_far_more_there(self, share_of) -> None:  # type: ignore[no-untyped-def]
        assert share_of(answering(COMMANDS), 1.0) < 0.1

    def test_a_slow_lag_on_a_walk_errs_as_much(self, share_of) -> None:  # type: ignore[no-untyped-def]
        assert share_of(walking(COMMANDS), SLOW_S) == pytest.approx(1.0, abs=0.05)

    def test_nothing_is_told_where_no_command_moves(self, share_of) -> None:  # type: ignore[no-untyped-def]
        assert share_of(answering(np.ones(ROWS)), 1.0) is None


@pytest.mark.parametrize("seed", [3, 6, 15])
def test_nothing_is_said_of_two_walks(seed: int) -> None:
    result = diagnose(NOMINAL, [surrogate("random walk", seed)])
    assert (result.verdict, result.effects, result.candidates) == ("unexplained", (), ())
    assert result.sentences[0].startswith("Nothing is said of what is missing")
    assert (result.extended_model.blocks, result.extended_model.effects) == (NOMINAL.blocks, ())


def test_nothing_is_said_of_a_plant_that_its_controller_alone_moves() -> None:
    """A PI loop that coloured noise drives: a bend of the command made the model into the controller's inverse."""
    result = diagnose(NOMINAL, [surrogate("linear loop", 79)])
    assert (result.verdict, result.effects, result.candidates) == ("unexplained", (), ())
    assert "u does nothing but follow y" in result.sentences[0]


def test_a_sign_is_reversed_though_an_effect_explains_as_much() -> None:
    """Both are judged on the same stretches: an error on half the windows is larger than on an eighth of the rows."""
    result = diagnose(NOMINAL, [surrogate("wrong sign", 9)])
    assert "the sign of u" in result.sentences[0]
    assert not result.effects
