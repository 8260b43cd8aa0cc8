"""A rig is commissioned the same way whatever the units and signs of command and reading, and however slow it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from autotune.config import Config, load_config
from autotune.controller import PIDController
from autotune.pipeline.run import Tuning, tune
from drivers.simulated import SimulatedRig
from sim.ball import make_ball
from sim.plant import Plant
from sim.servo import make_servo
from tests.autotune.experiment.rigs import CONFIG


@dataclass(frozen=True, kw_only=True)
class Form:
    """How one rig is written: units of u and y in its first ones, the sign of an actuator, seconds in one of its."""

    of_u: float = 1.0
    of_y: float = 1.0
    of_time: float = 1.0


class Rewritten:
    """A plant in another form; powers of two and signs leave every digit as it is."""

    def __init__(self, plant: Plant, form: Form) -> None:
        self._plant, self._form = plant, form

    @property
    def time_s(self) -> float:
        """Time the plant has lived [s]."""
        return self._plant.time_s * self._form.of_time

    @property
    def u_applied(self) -> float:
        """Command the actuator really holds."""
        return self._plant.u_applied * self._form.of_u

    @property
    def u_rest(self) -> float:
        """Truth: command at rest."""
        return self._plant.u_rest * self._form.of_u

    @property
    def y_true(self) -> float:
        """Truth: the sensor's signal before noise and converter."""
        return self._plant.y_true * self._form.of_y

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command."""
        self._plant.advance(u / self._form.of_u, dt_s / self._form.of_time)

    def measure(self) -> float:
        """Return one measurement."""
        return self._plant.measure() * self._form.of_y

    def response(self, omega_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Truth: small-signal complex gain."""
        gain = self._form.of_y / self._form.of_u
        return gain * self._plant.response(omega_rad_s * self._form.of_time)


def rewritten(config: Config, form: Form) -> Config:
    """Return the configuration of the rig in another form."""
    limits, point, wanted = config.limits, config.operating_point, config.experiment
    assert config.controller is not None
    u_ends = sorted((limits.u_min * form.of_u, limits.u_max * form.of_u))
    y_ends = sorted((limits.y_min * form.of_y, limits.y_max * form.of_y))
    u, y = abs(form.of_u), abs(form.of_y)
    sections = {
        "signals": {
            "sample_time_s": config.signals.sample_time_s * form.of_time,
            "u_step": config.signals.u_step * u,
        },
        "limits": {
            "u_min": u_ends[0],
            "u_max": u_ends[1],
            "u_safe": limits.u_safe * form.of_u,
            "u_rate": limits.u_rate * u / form.of_time,
            "y_min": y_ends[0],
            "y_max": y_ends[1],
            "swing": limits.swing * y,
            "time_s": limits.time_s * form.of_time,
        },
        "operating_point": {
            "y": point.y * form.of_y,
            "u_guess": point.u_guess * form.of_u,
            "u_uncertainty": point.u_uncertainty * u,
        },
        "experiment": {"budget_s": wanted.budget_s * form.of_time},
        "controller": {
            "K": config.controller.K * form.of_u / form.of_y,
            "Ti_s": config.controller.Ti_s * form.of_time,
        },
    }
    return config.model_copy(
        update={name: getattr(config, name).model_copy(update=keys) for name, keys in sections.items()}
    )


def commissioned(plant: Plant, config: Config, form: Form, folder: Path) -> Tuning:
    """Return how the rig in this form was commissioned."""
    config = rewritten(config, form)
    assert config.controller is not None
    old = PIDController(K=config.controller.K, Ti_s=config.controller.Ti_s)
    rig = SimulatedRig(Rewritten(plant, form), u_safe=config.limits.u_safe, controller=old)
    folder.mkdir()
    return tune(rig, config, folder)


@dataclass(frozen=True, kw_only=True)
class Rig:
    """A rig that is commissioned again and again: what it is, and what it was tuned to in its first form."""

    make: Callable[[], Plant]
    config: Config
    tuning: Tuning


@pytest.fixture(scope="module", params=["ball", "servo"])
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """Return a ball that is approached with a ramp, or a servo that is held where it is."""
    make = partial(make_ball if request.param == "ball" else make_servo, seed=1)
    config = load_config(CONFIG.with_name(f"{request.param}_sim.toml"))
    folder = tmp_path_factory.mktemp(request.param) / "here"
    return Rig(make=make, config=config, tuning=commissioned(make(), config, Form(), folder))


FORMS = {
    "sensor the other way, thousandths": Form(of_u=2.0**10, of_y=-(2.0**-20)),
    "a thousand times slower": Form(of_time=2.0**10),
}


def require_same(here: Tuning, there: Tuning, form: Form) -> None:
    of_gain = form.of_u / form.of_y
    for one, other in zip(here.experiment.points, there.experiment.points, strict=True):
        assert other.omega_rad_s * form.of_time == pytest.approx(one.omega_rad_s, rel=1e-9)
        assert other.response * of_gain == pytest.approx(one.response, rel=1e-6)
    assert there.analysis.controller.K / of_gain == pytest.approx(here.analysis.controller.K, rel=2e-5)
    assert there.analysis.controller.Ti_s / form.of_time == pytest.approx(here.analysis.controller.Ti_s, rel=2e-5)
    assert there.analysis.margins.phase_rad == pytest.approx(here.analysis.margins.phase_rad, rel=2e-5)
    assert there.deployed == here.deployed


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_a_rig_in_another_form_is_the_same_rig(rig: Rig, form: Form, tmp_path: Path) -> None:
    require_same(rig.tuning, commissioned(rig.make(), rig.config, form, tmp_path / "there"), form)


def test_an_actuator_that_acts_the_other_way_is_ramped_from_its_own_side(tmp_path: Path) -> None:
    """A valve that its spring opens is safe at its upper end: on the way to the lower one the ball would be thrown."""
    config, form = load_config(CONFIG), Form(of_u=-1.0)
    here = commissioned(make_ball(seed=2), config, Form(), tmp_path / "here")
    there = commissioned(make_ball(seed=2), config, form, tmp_path / "there")
    require_same(here, there, form)
    assert there.deployed
