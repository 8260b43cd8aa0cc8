"""An effect has one home: its record. Nothing of models of equations knows one by its name."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import autotune
from autotune.effects import ALL, KINDS, counted_as
from autotune.effects.in_equations import MOVING
from autotune.equations.expressions import names_in, parse
from autotune.errors import InputError
from autotune.model_file import read_any

ROOT = Path(autotune.__file__).parent
IN_EQUATIONS = {kind.name: kind.in_equations for kind in ALL if kind.in_equations is not None}
FILES = [path for folder in ("equations", "diagnosis/equations") for path in sorted((ROOT / folder).glob("*.py"))]


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_no_effect_is_known_by_its_name(path: Path) -> None:
    """Neither whole names nor what begins or ends one is a text in the code."""
    texts = [node.value for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
             if isinstance(node, ast.Constant) and isinstance(node.value, str)]  # fmt: skip
    parts = {*KINDS, *(f"{kind.place}." for kind in ALL)}
    assert [text for text in texts if text in parts or (text.startswith(tuple(f"{k.name.split('.')[1]}_" for k in ALL))
            and text.endswith("_"))] == []  # fmt: skip


@pytest.mark.parametrize("name", IN_EQUATIONS)
def test_a_record_states_every_name_of_its_expressions(name: str) -> None:
    form, kind = IN_EQUATIONS[name], KINDS[name]
    texts = [form.text, form.at_once, *(slope for _, slope in form.memory)]
    used = set().union(*(names_in(parse(text)) for text in texts if text))
    known = {"V", "X", "value", "column", "t", "pi", *(memory for memory, _ in form.memory)}
    numbers = {q.name for q in kind.parameters} | set(form.defaults) | set(form.further)
    assert used <= known | numbers
    assert {*form.given, *form.jumps, *form.levels, *form.either_sign, *form.spread, *form.least} <= numbers
    assert bool(form.on) is (form.acts == "force")
    assert bool(form.samples) is (form.acts == "held")


def test_every_effect_says_in_words_what_it_is() -> None:
    assert [kind.name for kind in ALL if not all(kind.words)] == []
    assert len({kind.words[1] for kind in ALL}) >= len(ALL) - 2  # lags of actuator and sensor say the same


def test_friction_acts_on_what_moves() -> None:
    frictions = {name for name, form in IN_EQUATIONS.items() if "friction" in name and set(form.on) == set(MOVING)}
    assert frictions == {"plant.coulomb_friction", "plant.stribeck_friction", "plant.viscous_friction"}


def test_an_effect_of_equations_alone_is_refused_in_a_chain(tmp_path: Path) -> None:
    file = tmp_path / "m.toml"
    file.write_text(
        'name = "m"\n[[block]]\nname = "p"\nplace = "plant"\nnum = [1.0]\nden = [1.0, 1.0]\n'
        '[[effect]]\nname = "plant.viscous_friction"\n[effect.parameters.coefficient]\nvalue = 1.0\n'
    )
    with pytest.raises(InputError, match="models of equations alone"):
        read_any(file)


def test_effects_that_cannot_be_told_apart_say_so_of_one_another() -> None:
    """One of which no other says so is free in every fit."""
    for kind in ALL:
        for other in (KINDS[other] for other in kind.same if KINDS[other].same):
            assert {other.name, *other.same} == {kind.name, *kind.same}
        assert all(counted_as(other) == counted_as(kind.name) for other in kind.like)
