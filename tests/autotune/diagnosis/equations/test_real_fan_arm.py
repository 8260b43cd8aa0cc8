"""A real arm that a fan lifts, beside the checkout: thrust and gravity in the equations, dry friction left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from autotune.diagnosis import diagnose
from autotune.equations.model import EquationModel
from autotune.equations.read import equations_of
from autotune.recording import Recording, read_recording


def recording(shared: Path, name: str, every: int = 2) -> Recording:
    """Return every second row, or as many, of a recording of the arm."""
    file = shared / "real_cases" / "case_04" / f"{name}.csv"
    if not file.exists():
        pytest.skip("no real recordings beside the checkout")
    r = read_recording(file)
    return Recording(t=r.t[::every], u=r.u[::every], y=r.y[::every], name=name)


def arm(acceleration: str, **numbers: object) -> EquationModel:
    """Return the arm's equations: a fan that follows its command, and what it and the arm's weight do."""
    content = {
        "name": "fan arm", "input": [{"column": "u"}], "output": {"value": "theta", "unit": "rad"},
        "state": [
            {"name": "n", "kind": "other", "derivative": "(u - n)/T"},
            {"name": "theta", "unit": "rad", "kind": "position", "derivative": "omega"},
            {"name": "omega", "kind": "speed", "of": "theta", "derivative": acceleration},
        ],
        "parameters": {"T": 0.0574, "c": {"value": 3.5, "spread": 0.5}, "G": 165.0, **numbers},
    }  # fmt: skip
    return equations_of(content, "arm.toml")


WITH_GRAVITY = arm("k*n^2 - c*omega - G*sin(theta)", k=73.0)

#: Its tangent at the middle of the range: neither the fan's square nor gravity's sine is in it.
LINEAR = arm("k*(n - u0) - c*omega - G*theta", k=100.0, u0=0.68)


@pytest.mark.slow
def test_dry_friction_is_what_thrust_and_gravity_leave_out(shared: Path) -> None:
    """The nominal thrust is twice what it is, so that the arm would go over the top; the rig leaves more than noise."""
    found = diagnose(WITH_GRAVITY, [recording(shared, "fit")])
    assert found.verdict == "effect"
    assert [(e.name, e.state) for e in found.effects] == [("plant.coulomb_friction", "omega")]
    assert found.effects[0].parameters["level"].value == pytest.approx(1.6, rel=0.15)
    nominal, retuned, extended = found.fit.nominal, found.fit.retuned, found.fit.extended
    assert nominal > 1.0  # of the spread of y: the nominal arm goes over the top
    assert extended < 0.75 * retuned < 0.1


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_tangent_without_gravity_says_the_same_gravity_and_friction(shared: Path) -> None:
    """The spring comes to nothing beside gravity, which is as with gravity in the nominal: 195 to 198 rad/s^2."""
    first, second = (recording(shared, name, every=1) for name in ("fit", "test"))
    from_gravity = diagnose(WITH_GRAVITY, [first])
    from_tangent = diagnose(LINEAR, [first, second])
    assert from_gravity.verdict == from_tangent.verdict == "effect"
    (friction,) = from_gravity.effects
    others = {e.name: e.parameters for e in from_tangent.effects}
    assert others["plant.sine_torque"]["amplitude"].value == pytest.approx(196.0, rel=0.05)
    told, again = friction.parameters["level"], others["plant.coulomb_friction"]["level"]
    assert abs(told.value - again.value) < told.sd + again.sd
    assert from_tangent.fit.extended < 0.4 * from_tangent.fit.retuned
