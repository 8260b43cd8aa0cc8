"""One plant written in another form is the same plant: the same numbers are retuned, and the same is said."""

from __future__ import annotations

from dataclasses import replace

import pytest

from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.fitting.parameters import parametrise
from autotune.effects import KINDS
from autotune.models import Block, Model, TransferFunction
from tests.autotune.diagnosis.servo_rigs import GAIN, TAU, servo_model, servo_recording

FEW = ("plant.quadratic_drag", "plant.coulomb_friction", "actuator.saturation", "sensor.lag", "plant.hard_stop")


def block(name: str, place: str, num: float, *den: float) -> Block:
    return Block(name=name, place=place, dynamics=TransferFunction(num=(num,), den=den))


FORMS: dict[str, tuple[Block, ...]] = {
    "one block": (block("shaft", "plant", GAIN, TAU, 1.0, 0.0),),
    "gain in the sensor": (
        block("mass", "plant", GAIN / 40.0, TAU, 1.0),
        block("position", "plant", 1.0, 1.0, 0.0),
        block("potentiometer", "sensor", 40.0, 1.0),
    ),
    "speed in turns a minute": (
        block("mass", "plant", GAIN * 60.0 / 6.283185307179586, TAU, 1.0),
        block("position", "plant", 6.283185307179586 / 60.0, 1.0, 0.0),
    ),
    "gain in the amplifier": (
        block("amplifier", "actuator", GAIN, 1.0),
        block("mass", "plant", 1.0, TAU, 1.0),
        block("position", "plant", 1.0, 1.0, 0.0),
    ),
}


def in_form(name: str) -> Model:
    return replace(servo_model(), blocks=FORMS[name])


@pytest.mark.parametrize("form", FORMS)
def test_the_lag_and_the_gain_are_retuned_in_every_form(form: str) -> None:
    def retuned(model: Model) -> list[tuple[str, float]]:
        return sorted((one.kind, one.spread) for one in parametrise(model, [], 1.0, 0.02).free)

    assert retuned(in_form(form)) == retuned(servo_model())


@pytest.mark.parametrize("form", FORMS)
def test_a_diagnosis_is_the_same_in_every_form(form: str) -> None:
    others = [name for name in KINDS if name not in FEW]
    recordings = [servo_recording(seed, lambda x, v: -0.2 * v * abs(v) / GAIN, rows=900) for seed in (1, 2)]
    one, other = (diagnose(model, recordings, without=others) for model in (servo_model(), in_form(form)))
    assert [e.name for e in one.effects] == ["plant.quadratic_drag"]
    assert [e.name for e in other.effects] == [e.name for e in one.effects]
    assert other.effects[0].together == pytest.approx(one.effects[0].together, abs=1e-6)
    assert other.fit.extended == pytest.approx(one.fit.extended, rel=1e-4)
    coefficient = [found.effects[0].parameters["coefficient"].value for found in (one, other)]
    assert coefficient[1] == pytest.approx(coefficient[0], rel=1e-4)


def test_recordings_in_another_order_tell_the_same() -> None:
    """The first is shorter: of stretches cut through both, one after the other, each order had its own."""
    others = [name for name in KINDS if name not in FEW]
    shorter, longer = (
        servo_recording(seed, lambda x, v: -0.2 * v * abs(v) / GAIN, rows=rows) for seed, rows in ((1, 700), (2, 900))
    )
    one, other = (diagnose(servo_model(), given, without=others) for given in ((shorter, longer), (longer, shorter)))
    assert [e.name for e in one.effects] == ["plant.quadratic_drag"]
    assert [(e.name, e.together) for e in other.effects] == [(e.name, e.together) for e in one.effects]
    assert other.fit == one.fit
    # it acts in the whole of each, counted as they were given
    for found, given in ((one, (shorter, longer)), (other, (longer, shorter))):
        assert set(found.effects[0].windows) == {(i, float(r.t[0]), float(r.t[-1])) for i, r in enumerate(given)}
