"""Real pendulums beside the checkout: gravity written into the equations, and equations without it."""

from __future__ import annotations

from pathlib import Path

import pytest

from autotune.diagnosis import Diagnosis, diagnose
from autotune.equations.read import equations_of
from autotune.recording import Recording, read_recording

#: Case, squared frequency and damping that are believed, rows that are used, every third of them.
SWINGS = {"m_03": (21.5, 0.06, 2400), "m_04": (40.0, 0.25, 2100)}


def diagnosed(shared: Path, case: str, torque: str) -> Diagnosis:
    believed, damping, rows = SWINGS[case]
    file = shared / "real_cases" / case / "fit.csv"
    if not file.exists():
        pytest.skip("no real recordings beside the checkout")
    r = read_recording(file)
    few = Recording(t=r.t[:rows:3], u=r.u[:rows:3], y=r.y[:rows:3], name=case)
    content = {
        "name": "pendulum", "input": [{"column": "u"}], "output": {"value": "theta", "unit": "rad"},
        "state": [
            {"name": "theta", "unit": "rad", "kind": "position", "derivative": "omega"},
            {"name": "omega", "kind": "speed", "of": "theta", "derivative": f"u - c*omega - k*{torque}"},
        ],
        "parameters": {"c": {"value": damping, "spread": 0.5}, "k": {"value": believed}},
    }  # fmt: skip
    model = equations_of(content, "pendulum.toml")
    return diagnose(model, [few])


def friction(found: Diagnosis) -> float:
    (level,) = (e.parameters["level"].value for e in found.effects if e.name == "plant.coulomb_friction")
    return float(level)


@pytest.mark.parametrize("case", ["m_04", pytest.param("m_03", marks=pytest.mark.slow)])
def test_with_gravity_in_the_equations_dry_friction_is_what_is_left_out(shared: Path, case: str) -> None:
    found = diagnosed(shared, case, "sin(theta)")
    assert found.verdict == "effect"
    assert [e.name for e in found.effects] == ["plant.coulomb_friction"]
    assert found.effects[0].state == "omega"
    nominal, retuned, extended = found.fit.nominal, found.fit.retuned, found.fit.extended
    assert extended < 0.2 * min(nominal, retuned)


@pytest.mark.slow
@pytest.mark.parametrize("case", SWINGS)
def test_without_gravity_the_friction_is_the_same(shared: Path, case: str) -> None:
    """A spring that softens, a sine, or both, stand for gravity; on m_03 a bend of the reading is named beside them."""
    with_gravity = friction(diagnosed(shared, case, "sin(theta)"))
    without = diagnosed(shared, case, "theta")
    names = {e.name for e in without.effects}
    assert names & {"plant.cubic_stiffness", "plant.sine_torque"}
    assert names <= {"plant.cubic_stiffness", "plant.sine_torque", "plant.coulomb_friction", "sensor.nonlinear_gain"}
    assert friction(without) == pytest.approx(with_gravity, rel=0.05)
