"""A real arm that a fan lifts, beside the checkout: thrust and gravity in the equations, dry friction left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from autotune.diagnosis.equations import diagnose_equations
from autotune.equations.read import equations_of
from autotune.recording import Recording, read_recording


@pytest.mark.slow
def test_dry_friction_is_what_thrust_and_gravity_leave_out(shared: Path) -> None:
    """The nominal thrust is twice what it is, so that the arm would go over the top; the rig leaves more than noise."""
    file = shared / "real_cases" / "case_04" / "fit.csv"
    if not file.exists():
        pytest.skip("no real recordings beside the checkout")
    r = read_recording(file)
    few = Recording(t=r.t[::2], u=r.u[::2], y=r.y[::2], name="fan arm")
    content = {
        "name": "fan arm", "input": [{"column": "u"}], "output": {"value": "theta", "unit": "rad"},
        "state": [
            {"name": "n", "kind": "other", "derivative": "(u - n)/T"},
            {"name": "theta", "unit": "rad", "kind": "position", "derivative": "omega"},
            {"name": "omega", "kind": "speed", "of": "theta", "derivative": "k*n^2 - c*omega - G*sin(theta)"},
        ],
        "parameters": {"T": 0.0574, "k": 73.0, "c": {"value": 3.5, "spread": 0.5}, "G": 165.0},
    }  # fmt: skip
    found = diagnose_equations(equations_of(content, "arm.toml"), [few])
    assert found.verdict == "effect"
    assert [(e.name, e.state) for e in found.effects] == [("plant.coulomb_friction", "omega")]
    assert found.effects[0].parameters["level"].value == pytest.approx(1.6, rel=0.15)
    nominal, retuned, extended, _ = found.errors
    assert nominal > 1.0  # of the spread of y: the nominal arm goes over the top
    assert extended < 0.75 * retuned < 0.1
