"""Where y has nothing to do with u, or is not y, no physics is said to be missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from autotune.diagnosis import Diagnosis, diagnose
from autotune.equations.model import EquationModel
from autotune.errors import IdentificationError
from autotune.experiment_design import next_experiment
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording
from autotune.report.diagnosis_words import answers
from tests.autotune.equations.models import one_state

OVEN = Model(
    name="oven",
    input=Port(unit="%", offset=5.0),
    output=Port(unit="degC", offset=50.0),
    blocks=(Block(name="oven", place="plant", dynamics=TransferFunction(num=(2.0,), den=(9.5, 1.0), delay_s=3.0)),),
)


#: The same without its dead time.
SOONER = replace(OVEN, blocks=(replace(OVEN.blocks[0], dynamics=TransferFunction(num=(2.0,), den=(9.5, 1.0))),))
#: And as equations.
EQUATIONS = one_state("(K*(u - 5) - x)/T", {"K": 2.0, "T": 9.5}, output="x + 50")


def oven(seed: int, rows: int = 800, gain: float = 2.0, delay: int = 3) -> Recording:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([4.5, 5.5], rows // 20 + 1), 20)[:rows]
    late = np.concatenate([np.full(delay, u[0]), u[:-delay]]) - 5.0
    y = 50.0 + gain * lfilter([0.1], [1.0, -0.9], late) + 0.05 * rng.standard_normal(rows)
    return Recording(t=np.arange(rows, dtype=np.float64), u=u, y=y)


def first_words(found: Diagnosis) -> str:
    assert not found.effects
    assert found.fit.extended == found.fit.retuned  # nothing is put into the model that is handed out
    assert found.verdict == "unexplained"
    return found.sentences[0]


@pytest.mark.parametrize("seed", [101, 102])
def test_a_reversed_sign_is_said_first_and_is_no_physics(seed: int) -> None:
    found = diagnose(OVEN, [oven(seed, gain=-2.0)])
    assert "the sign of u, or of the model's gain, is reversed" in first_words(found)
    assert next_experiment(found) is None  # a better recording of the wrong sign tells no more
    assert dict(answers(found))["What was found"] == found.sentences[0]


@pytest.mark.parametrize("delay", [3, 15])
@pytest.mark.parametrize("model", [SOONER, EQUATIONS], ids=["chain", "equations"])
def test_a_reversed_sign_is_said_first_of_a_model_that_lacks_the_dead_time_too(
    model: Model | EquationModel, delay: int
) -> None:
    """A nonlinear gain beside a dead time was named at .97: it follows y the wrong way round."""
    found = diagnose(model, [oven(101, gain=-2.0, delay=delay)])
    assert "is reversed" in first_words(found)


def test_a_dead_time_as_long_as_a_step_of_the_command_is_no_reversed_sign() -> None:
    found = diagnose(SOONER, [oven(101, delay=20)])
    assert [effect.name for effect in found.effects] == ["timing.dead_time"]


@pytest.mark.parametrize("model", [OVEN, EQUATIONS], ids=["chain", "equations"])
def test_a_copy_of_the_command_is_said_to_be_one(model: Model | EquationModel) -> None:
    u = oven(101).u
    with pytest.raises(IdentificationError, match="one signal under two names"):
        diagnose(model, [Recording(t=np.arange(800.0), u=u, y=2.0 * u - 3.0)])


@pytest.mark.parametrize("seed", [101, 102])
def test_exchanged_columns_are_said_first(seed: int) -> None:
    right = oven(seed)
    assert "the columns u and y are exchanged" in first_words(diagnose(OVEN, [replace(right, u=right.y, y=right.u)]))


def test_columns_as_they_should_be_are_not_accused() -> None:
    found = diagnose(OVEN, [oven(103)])
    assert found.verdict in ("none", "parameters")
    assert not any("reversed" in sentence or "exchanged" in sentence for sentence in found.sentences)


def test_white_noise_for_u_and_y_is_missing_no_physics() -> None:
    rng = np.random.default_rng(2)
    u, y = 5.0 + rng.standard_normal(2000), 50.0 + rng.standard_normal(2000)
    found = diagnose(OVEN, [Recording(t=np.arange(2000.0), u=u, y=y)])
    assert "follows nothing" in first_words(found)


def test_a_command_that_never_moves_is_not_asked_to_be_the_reading() -> None:
    y = 50.0 + np.cumsum(np.random.default_rng(0).standard_normal(300))
    found = diagnose(OVEN, [Recording(t=np.arange(300.0), u=np.full(300, 5.0), y=y)])
    assert not any("exchanged" in sentence for sentence in found.sentences)
    assert not found.effects
