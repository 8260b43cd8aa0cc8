from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.config import load_config
from autotune.config.procedure import DesignSettings
from autotune.controller import PIDController
from autotune.errors import IdentificationError, LinkError
from autotune.experiment.rig import Reading
from autotune.models import TransferFunction
from autotune.pipeline import analyse, hand_over, tune
from autotune.points import FrequencyPoint
from drivers.simulated import SimulatedRig
from sim.plant import make_plant

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))
OLD = PIDController(K=-0.01, Ti_s=6.0)


def points_of(plant: TransferFunction, omega: np.ndarray, relative_sd: float) -> list[FrequencyPoint]:
    return [
        FrequencyPoint(
            omega_rad_s=float(w),
            response=complex(plant.response(np.array([w]))[0]),
            covariance=((float((abs(plant.response(np.array([w]))[0]) * relative_sd) ** 2), 0.0),
                        (0.0, float((abs(plant.response(np.array([w]))[0]) * relative_sd) ** 2))),
        )
        for w in omega
    ]  # fmt: skip


class Changing(SimulatedRig):
    """The ball rig whose actuator becomes stronger after the sweep, as when somebody opens a valve."""

    stronger = 1.0

    def read(self) -> Reading:
        return replace(super().read(), u_applied=math.nan)  # this rig does not say what it applies

    def live(self, dt_s: float) -> None:
        self.plant.advance(4.9 + self.stronger * (self.command - 4.9), dt_s)

    def close(self) -> None:
        super().close()
        self.stronger = 1.4


class RefusesGains(SimulatedRig):
    """A rig whose link breaks when the gains of the new controller are written."""

    def write_gains(self, controller: PIDController) -> None:
        if controller != OLD:
            raise LinkError("no answer")
        super().write_gains(controller)


def test_exact_points_of_the_ball_give_the_optimum_of_its_reduced_model() -> None:
    analysis = analyse(points_of(BALL, np.array([0.9, 1.5, 2.4, 3.5, 5.0]), 1e-5), DesignSettings())
    # FACTS: largest omega_d that C2 allows on (23) is 5.2138, smallest |G_r| 65.5
    assert analysis.reduced.G_r == pytest.approx(-65.5, rel=2e-3)
    assert analysis.reduced.omega_d_rad_s == pytest.approx(5.2138, rel=5e-3)
    assert analysis.design.h2 == pytest.approx(58.1, rel=0.02)
    assert analysis.margins.modulus > analysis.design.margins.modulus  # Proposition 1
    assert analysis.margins.phase_rad > analysis.design.margins.phase_rad
    assert not analysis.unscaled.holds  # (10) as printed fails: the nu-gap depends on the units
    assert analysis.scaled.holds


def test_points_that_do_not_reach_135_degrees_are_refused_with_the_mend() -> None:
    with pytest.raises(IdentificationError, match="higher frequency"):
        analyse(points_of(BALL, np.array([0.1, 0.2, 0.3]), 1e-3), DesignSettings())


def test_a_plant_that_changed_is_noticed_and_the_old_gains_stay(tmp_path: Path) -> None:
    config = load_config(CONFIGS / "ball_sim.toml")
    rig = Changing(make_plant("ball", seed=4, noise=0.1), u_safe=0.0, controller=OLD)
    tuning = tune(rig, config, tmp_path)
    assert tuning.verification is not None
    assert not tuning.verification.accepted
    assert not tuning.deployed
    assert rig.read_gains() == OLD
    assert rig.command == 0.0


def test_gains_that_cannot_be_written_are_taken_back(tmp_path: Path) -> None:
    rig = RefusesGains(make_plant("ball", seed=4), u_safe=0.0, controller=OLD)
    journal = tmp_path / "journal.jsonl"
    with pytest.raises(LinkError, match="old gains are in place"):
        hand_over(rig, PIDController(K=-0.02, Ti_s=3.0), journal)
    assert rig.read_gains() == OLD
    assert [line.split('"')[3] for line in journal.read_text().splitlines()] == [
        "read", "writing", "restoring", "restored",
    ]  # fmt: skip
