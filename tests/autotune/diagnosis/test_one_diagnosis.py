"""A plant is diagnosed alike as a chain and as equations: the same name, size and probability, the same words."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.diagnosis import diagnose
from autotune.diagnosis.equations.evidence import EquationEvidence
from autotune.diagnosis.equations.gathering_equations import evidence_of_equations
from autotune.diagnosis.findings import LEAST, consistent, found_effects
from autotune.diagnosis.result import Diagnosis
from autotune.diagnosis.selection.probability import Candidate
from autotune.diagnosis.thresholds import IN_USE
from autotune.effects import CATALOGUE, KINDS, counted_as
from autotune.equations.chain import chain_with_inputs
from autotune.equations.files import forecast_any
from autotune.equations.model import EquationModel
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.progress import quiet
from autotune.recording import Recording
from tests.autotune.equations.models import model as pendulum
from tests.autotune.equations.models import one_state

K, TAU, LEVEL, DT, INNER = 12.0, 0.9, 0.35, 0.01, 40
OTHERS = tuple(name for name in KINDS if name not in ("plant.coulomb_friction", "plant.quadratic_drag"))

CHAIN = Model(
    name="motor",
    input=Port(unit="V"),
    output=Port(unit="rad"),
    blocks=(
        Block(name="speed", place="plant", dynamics=TransferFunction(num=(11.0,), den=(1.0, 1.0)), output="speed",
              unit="rad/s"),
        Block(name="angle", place="plant", dynamics=TransferFunction(num=(1.0,), den=(1.0, 0.0)), output="angle",
              unit="rad"),
    ),
)  # fmt: skip
STATES = [
    {"name": "theta", "derivative": "omega", "unit": "rad", "kind": "position"},
    {"name": "omega", "derivative": "(K*u - omega)/tau", "unit": "rad/s", "kind": "speed", "of": "theta"},
]
EQUATIONS = pendulum(
    name="motor", input=[{"column": "u", "unit": "V"}], output={"value": "theta", "unit": "rad"}, state=STATES,
    parameters={"K": {"value": 11.0, "unit": "rad/s/V"}, "tau": {"value": 1.0, "unit": "s"}},
)  # fmt: skip


def turned(seed: int, rows: int = 1200, load: float = 0.0) -> Recording:
    """A motor with dry friction, exactly from one small step to the next; it stops where its speed changes sign."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-3.0, 3.0, rows // 60), 60)
    d = np.repeat(rng.uniform(-1.0, 1.0, rows // 50), 50)
    h = DT / INNER
    theta = omega = 0.0
    y = np.empty(rows)
    for k in range(rows):
        y[k] = theta
        drive = u[k] + load * d[k]
        for _ in range(INNER):
            way = math.copysign(1.0, omega) if omega else math.copysign(1.0, drive)
            goal = 0.0 if omega == 0.0 and abs(drive) <= LEVEL else K * (drive - way * LEVEL)
            stops = omega * goal < 0.0 and goal + math.exp(-h / TAU) * (omega - goal)
            kept = goal / (goal - omega) if stops and stops * omega < 0.0 else math.exp(-h / TAU)
            theta += -TAU * math.log(kept) * goal + (omega - goal) * TAU * (1.0 - kept)
            omega = 0.0 if stops and stops * omega < 0.0 else goal + kept * (omega - goal)
    y += 0.02 * rng.normal(size=rows)
    return Recording(t=np.arange(rows, dtype=np.float64) * DT, u=u, y=y, extra={"d": d} if load else {})


@cache
def found(as_equations: bool) -> Diagnosis:
    return diagnose(EQUATIONS if as_equations else CHAIN, [turned(1)], without=OTHERS)


def test_dry_friction_of_a_motor_has_one_name_size_and_probability() -> None:
    (one,), (other,) = found(False).effects, found(True).effects
    assert one.name == other.name == "plant.coulomb_friction"
    assert one.probability == pytest.approx(other.probability, abs=0.05)
    sizes = [e.as_command["level"] for e in (one, other)]
    assert [p.unit for p in sizes] == ["V", "V"]
    assert sizes[0].value == pytest.approx(sizes[1].value, rel=0.02)
    assert sizes[1].value == pytest.approx(LEVEL, rel=0.02)
    assert other.parameters["level"].unit == "rad/s^2"
    assert found(False).fit.extended < 0.05 * found(False).fit.retuned
    assert found(True).fit.extended < 0.05 * found(True).fit.retuned


def test_both_say_the_same_things_in_the_same_file() -> None:
    chain, equations = found(False).as_json(), found(True).as_json()
    assert chain.keys() == equations.keys()
    assert chain["effects"][0].keys() == equations["effects"][0].keys()
    assert equations["effects"][0]["operating_range"]["unit"] == "rad/s"
    assert {*chain["parameters"]} == {"speed gain", "speed time constant", "input operating point"}
    for said in (chain, equations):
        listed = sum(c["probability"] for c in said["candidates"] if "coulomb_friction" in c["name"])
        assert listed == pytest.approx(said["effects"][0]["probability"], abs=2e-3)


@pytest.mark.parametrize("as_equations", [False, True])
def test_the_law_is_shown_with_data_that_agree_with_it_and_contradict_its_absence(as_equations: bool) -> None:
    (law,) = found(as_equations).search.laws()
    (branch,) = law.branches
    off = np.abs(branch.found - np.interp(branch.at, branch.x, branch.law))
    size = float(np.ptp(branch.law))
    assert branch.at.size >= 5
    assert np.median(off) < 0.1 * size
    assert np.mean(np.abs(branch.found) > 1.96 * branch.error) > 0.7


@pytest.mark.parametrize("as_equations", [False, True])
def test_numbers_are_those_that_no_row_of_the_run_was_fitted_to(as_equations: bool) -> None:
    run = found(as_equations).search.unseen_run()
    assert run is not None
    assert run.errors["extended"] < 0.1 * run.errors["retuned"]


def test_a_chain_with_a_second_input_finds_the_friction_beside_it() -> None:
    content = {
        "name": "motor",
        "input": [{"column": "u", "unit": "V"}, {"column": "d", "num": [0.4], "den": [1.0], "unit": "V"}],
        "output": {"unit": "rad"},
        "block": [
            {"name": "speed", "place": "plant", "num": [11.0], "den": [1.0, 1.0], "output": "speed", "unit": "rad/s"},
            {"name": "angle", "place": "plant", "num": [1.0], "den": [1.0, 0.0], "output": "angle", "unit": "rad"},
        ],
    }
    (effect,) = diagnose(chain_with_inputs(content, "m.toml"), [turned(2, load=0.5)], without=OTHERS).effects
    assert (effect.name, effect.state) == ("plant.coulomb_friction", "speed")
    assert effect.as_command["level"].value == pytest.approx(LEVEL, rel=0.05)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: replace(r, u=-r.u), "sign of u"),
        (lambda r: replace(r, u=r.y, y=r.u), "u and y are exchanged"),
    ],
)
def test_columns_that_are_misread_are_said_first_and_no_physics_beside(change, said: str) -> None:  # type: ignore[no-untyped-def]
    told = diagnose(one_state("(K*u - x)/T", {"K": 2.0, "T": 0.5}), [change(lag(3))], without=tuple(CATALOGUE))
    assert said in told.sentences[0]
    assert not told.effects
    assert not told.candidates
    assert told.extended_model.effects == ()


def lag(seed: int, rows: int = 600) -> Recording:
    """A lag of half a second with gain 2, exact from row to row."""
    rng = np.random.default_rng(seed)
    u, kept, x = np.repeat(rng.uniform(-1.0, 1.0, rows // 20), 20), math.exp(-0.05 / 0.5), 0.0
    y = np.empty(rows)
    for k in range(rows):
        y[k] = x
        x = kept * x + (1.0 - kept) * 2.0 * u[k]
    return Recording(t=np.arange(rows, dtype=np.float64) * 0.05, u=u, y=y + 0.01 * rng.normal(size=rows))


def shown(r: Recording) -> EquationEvidence:
    return evidence_of_equations(one_state("(K*u - x)/T", {"K": 2.0, "T": 0.5}), [r], None, OTHERS, quiet, IN_USE)


def test_what_samples_show_has_the_probability_that_a_simulation_gives_it() -> None:
    """A sensor that stands at its limit: how surely follows from how far the simulation goes beyond."""
    surely = []
    for limit in (0.6, 1.2, 1.6):
        r = lag(4)
        without = tuple(n for n in CATALOGUE if n != "sensor.saturation")
        clipped = replace(r, y=np.minimum(r.y, limit))
        model = one_state("(K*u - x)/T", {"K": 2.0, "T": 0.5})
        (seen,) = evidence_of_equations(model, [clipped], None, without, quiet, IN_USE).samples
        assert 4.0 < seen.speaks < math.inf
        (effect,) = diagnose(model, [clipped], without=without).effects
        assert effect.name == "sensor.saturation"
        assert effect.probability <= 1.0 / (1.0 + IN_USE.unknown_odds) + 1e-9
        surely.append(seen.speaks)
    assert surely[0] > surely[1] > 2.0 * surely[2]


def test_an_extended_model_that_runs_away_is_not_handed_out() -> None:
    evidence = shown(lag(5))
    away = Effect(
        name="plant.quadratic_drag", parameters={"coefficient": Parameter(value=-40.0)}, state="x"
    )  # fmt: skip
    found = evidence.found
    chosen = replace(found.chosen, names=(away.name,), outcome=replace(found.chosen.outcome, effects=(away,)))
    vars(chosen)["error"] = 0.0  # as if it foretold rows left out: only how it runs is against it
    dangerous = replace(evidence, found=replace(found, chosen=chosen))
    handed_out, wanted = dangerous.handed_out("effect")
    assert isinstance(wanted, EquationModel)
    assert [e.name for e in wanted.effects] == [away.name]
    assert handed_out.effects == ()


def test_what_is_not_kept_is_missing_from_the_evidence_of_equations_too() -> None:
    def cart(derivative: str) -> EquationModel:
        state = [{"name": "x", "derivative": derivative, "kind": "speed"}]
        numbers = {"K": {"value": 2.0}, "T": {"value": 0.5}}
        return pendulum(name="cart", input=[{"column": "u"}], output={"value": "x"}, state=state, parameters=numbers)

    plain, drag = cart("(K*u - x)/T"), cart("(K*u - x)/T - 0.5*x*abs(x)")
    r = lag(6)
    noisy = replace(r, y=forecast_any(drag, r) + 0.01 * np.random.default_rng(6).normal(size=len(r)))
    evidence = evidence_of_equations(plain, [noisy], None, OTHERS, quiet, IN_USE)
    assert evidence.names == ("plant.quadratic_drag",)
    assert [e.name for e in found_effects(evidence, "effect")] == ["plant.quadratic_drag"]
    without = evidence.keeping(())
    assert without.names == ()
    assert without.quality.extended == without.quality.retuned > evidence.quality.extended


NAMES = ("plant.coulomb_friction", "actuator.lag", "sensor.drift", "plant.leak")


@given(
    weights=st.dictionaries(
        st.frozensets(st.sampled_from(NAMES), max_size=3), st.floats(1e-3, 1.0), min_size=2, max_size=8
    ),
    p=st.floats(0.02, 0.97),
    q=st.floats(0.02, 0.97),
)
def test_hypotheses_of_an_effect_add_up_to_the_probability_that_is_stated_for_it(
    weights: dict[frozenset[str], float], p: float, q: float
) -> None:
    every = {"+".join(sorted(names)) or "none": w for names, w in weights.items()} | {"unknown": 0.05}
    # every combination of the two is possible, so that any two probabilities are
    every |= {name: 0.01 for name in ("none", NAMES[0], NAMES[1], f"{NAMES[0]}+{NAMES[1]}") if name not in every}
    total = sum(every.values())
    given_ = [Candidate(name=name, probability=w / total) for name, w in every.items()]
    told = consistent(given_, {NAMES[0]: p, NAMES[1]: q}, ())
    # what is less than the least is not listed
    assert -1e-9 <= 1.0 - sum(c.probability for c in told) < len(every) * LEAST + 1e-9
    for name, wanted in ((NAMES[0], p), (NAMES[1], q)):
        having = sum(c.probability for c in told if counted_as(name) & set(c.name.split("+")))
        assert having == pytest.approx(wanted, abs=2e-3)


def test_effects_whose_probabilities_exclude_one_another_give_the_same_hypotheses_in_any_order() -> None:
    dry, drag = "plant.coulomb_friction", "plant.quadratic_drag"
    given_ = [Candidate(name=name, probability=p) for name, p in ((dry, 0.5), (drag, 0.4), ("unknown", 0.1))]
    said = {drag: 0.6, dry: 0.7}  # no hypothesis has both, and together they are more than one
    one, other = (consistent(given_, dict(order), (dry,)) for order in (said.items(), reversed(said.items())))
    assert one == other
    assert sum(c.probability for c in one if dry in c.name.split("+")) == pytest.approx(0.7)
