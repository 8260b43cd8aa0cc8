"""A gain may be any block's: from the command to the reading nothing changes, whatever effect the chain has."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from autotune.diagnosis.simulation.assembly import assemble
from autotune.effects import kind_of
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.recording import Recording
from tests.autotune.diagnosis.simulation.test_chain_fmu import CASES, U

SENSOR = Block(name="sensor", place="sensor", dynamics=TransferFunction(num=(1.0,), den=(1.0,)))


def amplified(block: Block, gain: float) -> Block:
    return replace(block, dynamics=replace(block.dynamics, num=tuple(gain * c for c in block.dynamics.num)))


def with_effect(name: str, gain_of_forces: float = 1.0) -> Model:
    """Return the case of an effect; what is in units of the plant's input multiplied."""
    chain, values = CASES[name]
    units = {q.name: q.unit for q in kind_of(name).parameters}
    parameters = {
        key: Parameter(value=value * gain_of_forces ** units[key].startswith("{f}")) for key, value in values.items()
    }
    return replace(chain, effects=(Effect(name=name, parameters=MappingProxyType(parameters)),))


def reading(model: Model, u: np.ndarray = U) -> np.ndarray:
    sim = assemble(model)
    rows = Recording(t=np.arange(601.0), u=u[:601], y=np.zeros(601))
    return np.asarray(sim.run(rows, np.zeros(sim.order), signals=1)[0][:, 0])


def assert_same(one: np.ndarray, other: np.ndarray) -> None:
    np.testing.assert_allclose(one, other, atol=1e-7 * np.ptp(one), rtol=0.0)


@pytest.mark.parametrize("gain", [0.04, -25.0])
@pytest.mark.parametrize("name", CASES)
def test_an_effect_is_the_same_behind_a_plant_and_a_sensor_of_other_gains(name: str, gain: float) -> None:
    model = with_effect(name)
    last = max(i for i, block in enumerate(model.blocks) if block.place == "plant")
    plant, behind = model.blocks[: last + 1], model.blocks[last + 1 :] or (SENSOR,)
    moved = (*plant[:-1], amplified(plant[-1], 1.0 / gain), amplified(behind[0], gain), *behind[1:])
    assert_same(reading(replace(model, blocks=moved)), reading(replace(model, blocks=(*plant, *behind))))


@pytest.mark.parametrize("gain", [0.04, 25.0])
@pytest.mark.parametrize("name", CASES)
def test_an_effect_is_the_same_behind_an_actuator_of_another_gain(name: str, gain: float) -> None:
    model = with_effect(name, gain)
    valve, plant, *others = model.blocks
    blocks = (amplified(valve, gain), amplified(plant, 1.0 / gain), *others)
    assert_same(reading(replace(model, blocks=blocks)), reading(with_effect(name)))


@pytest.mark.parametrize("name", [name for name in CASES if name.startswith("plant.")])
def test_an_effect_of_the_plant_is_the_same_where_commands_move_it_the_other_way(name: str) -> None:
    signed = any(q.unit.startswith("{f}") and q.sign == "real" for q in kind_of(name).parameters)
    model, u = with_effect(name, -1.0 if signed else 1.0), 2.0 * CASES[name][0].input.offset - U
    first = next(i for i, block in enumerate(model.blocks) if block.place == "plant")
    blocks = (*model.blocks[:first], amplified(model.blocks[first], -1.0), *model.blocks[first + 1 :])
    assert_same(reading(replace(model, blocks=blocks), u), reading(with_effect(name)))


def carriage(*plant: Block) -> Model:
    valve = Block(name="drive", place="actuator", dynamics=TransferFunction(num=(1.0,), den=(2.0, 1.0)))
    return Model(name="carriage", input=Port(unit="V"), output=Port(unit="rad"), blocks=(valve, *plant))


def of_plant(num: tuple[float, ...], den: tuple[float, ...], unit: str) -> Block:
    return Block(name="plant", place="plant", dynamics=TransferFunction(num=num, den=den), unit=unit)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        (n, v)
        for n, (_, v) in CASES.items()
        if n not in ("plant.radiation_loss", "plant.nonlinear_loss", "plant.sqrt_outflow")
    ],
)
def test_an_effect_is_the_same_in_a_plant_written_as_one_block_or_as_speed_and_position(
    name: str, values: dict[str, float]
) -> None:
    effect = Effect(name=name, parameters=MappingProxyType({k: Parameter(value=v) for k, v in values.items()}))
    as_two = carriage(of_plant((0.3,), (8.0, 1.0), "rad/s"), of_plant((1.0,), (1.0, 0.0), "rad"))
    as_one = carriage(of_plant((0.3,), (8.0, 1.0, 0.0), "rad"))
    u = U - np.mean(U)
    one, two = (reading(replace(model, effects=(effect,)), u) for model in (as_one, as_two))
    assert_same(one, two)
