"""Every setting with a time in it means seconds, whatever the sample time is."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.config import Config
from autotune.config.procedure import ExperimentSettings, LimitSettings, OperatingPointSettings, VerificationSettings
from autotune.errors import AutotuneError, LinkError
from autotune.experiment.limits import Envelope
from autotune.experiment.run import bring_to_operating_point, run_experiment
from autotune.experiment.step_test import plan_test
from autotune.experiment.verify import law_for
from tests.autotune.experiment.rigs import ball_config, ball_rig, open_loop
from tests.autotune.experiment.test_verify import FIT, PI
from tests.sim.imperfections import Fault

SECTIONS = {
    "limits": LimitSettings,
    "operating_point": OperatingPointSettings,
    "experiment": ExperimentSettings,
    "verification": VerificationSettings,
}


def config_at(sample_time_s: float, **sections: dict[str, Any]) -> Config:
    signals = {"sample_time_s": sample_time_s, "u_step": 0.0}
    return ball_config(**sections | {"signals": signals})


def end_of(config: Config, folder: Path, *, fault_s: float = math.inf) -> float:
    """Return the time [s] at which a loop that holds the safe command is ended; a sensor shows nothing from then on."""
    faults = [Fault(kind="not a number", start_s=fault_s)] if math.isfinite(fault_s) else []
    loop = open_loop(ball_rig(faults=faults), folder / "loop.csv", config)
    with suppress(AutotuneError), loop:
        while True:
            loop.step(loop.nearest(0.0))
    return loop.tick.t_s


def longest(sample_time_s: float, folder: Path) -> None:
    config = config_at(sample_time_s, limits={"time_s": 3.0})
    assert end_of(config, folder) == pytest.approx(3.0, abs=2 * sample_time_s)


def blind(sample_time_s: float, folder: Path) -> None:
    config = config_at(sample_time_s, limits={"blind_s": 0.4, "time_s": 9.0})
    assert end_of(config, folder, fault_s=2.0) == pytest.approx(2.4, abs=2 * sample_time_s)


def late(sample_time_s: float, folder: Path) -> None:
    config = config_at(sample_time_s, limits={"late_s": 0.3})
    for behind_s, ends in ((0.25, False), (0.35, True)):
        loop = open_loop(ball_rig(), folder / f"late_{ends}.csv", config)
        said = ""
        try:
            with loop:
                loop.step(0.0)
                loop.rig.clock.sleep_until(loop.rig.clock.now() + sample_time_s + behind_s)
                loop.step(0.0)
        except LinkError as error:
            said = str(error)
        assert ("link too slow" in said) == ends


def rate(sample_time_s: float, folder: Path) -> None:
    config = config_at(sample_time_s, limits={"u_rate": 5.0})
    envelope, u = Envelope(settings=config.limits, sample_time_s=sample_time_s), 0.0
    for _ in range(round(0.2 / sample_time_s)):
        u = envelope.nearest(10.0, u)
    assert u == pytest.approx(5.0 * 0.2)


def ramp(sample_time_s: float, folder: Path) -> None:
    config = config_at(sample_time_s, operating_point={"ramp_rate": 0.1})
    loop = open_loop(ball_rig(seed=7), folder / "ramp.csv", config)
    with loop:
        bring_to_operating_point(loop, config)
        t, u, _ = loop.history()
    begun = int(np.argmax(u > 4.3))
    climbing = slice(begun, begun + round(0.5 / sample_time_s))
    assert float(np.polyfit(t[climbing], u[climbing], 1)[0]) == pytest.approx(0.1, rel=0.05)


def budget(sample_time_s: float, folder: Path) -> None:
    wanted = {"points": 2, "budget_s": 25.0, "gain_sd": 0.02}
    config = config_at(sample_time_s, experiment=wanted, limits={"u_rate": 1000.0})
    result = run_experiment(ball_rig(seed=7), config, folder / "sweep.csv")
    assert 5.0 < result.sweep_time_s <= 25.0


def duration(sample_time_s: float, folder: Path) -> None:
    config = config_at(sample_time_s, verification={"duration_s": 7.0})
    test = plan_test(config, law_for(PI, config.limits, sample_time_s), FIT, 1.0)
    assert test.settle * sample_time_s == pytest.approx(7.0, abs=sample_time_s)
    assert test.t[-1] == pytest.approx(14.0, abs=2 * sample_time_s)


#: what each setting does, measured
MEANS: dict[str, Callable[[float, Path], None]] = {
    "limits.time_s": longest,
    "limits.blind_s": blind,
    "limits.late_s": late,
    "limits.u_rate": rate,
    "operating_point.ramp_rate": ramp,
    "experiment.budget_s": budget,
    "verification.duration_s": duration,
}


def test_no_setting_with_a_time_in_it_is_left_out() -> None:
    timed = {
        f"{section}.{name}"
        for section, settings in SECTIONS.items()
        for name, field in settings.model_fields.items()
        if name.endswith("_s") or re.search(r"\[(s|\S.*/s)\]", field.description or "")
    }
    assert timed == set(MEANS)


@pytest.mark.parametrize("sample_time_s", [0.005, 0.01, 0.02])
@pytest.mark.parametrize("setting", MEANS)
def test_it_means_seconds(setting: str, sample_time_s: float, tmp_path: Path) -> None:
    MEANS[setting](sample_time_s, tmp_path)
