"""The page of a diagnosis: every effect in words, the chain with its places, nothing that contradicts itself."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from autotune.diagnosis.chain_evidence import ChainEvidence
from autotune.diagnosis.diagnose import WITHHELD, diagnose
from autotune.diagnosis.findings import sentences_of
from autotune.diagnosis.result import Diagnosis, FoundEffect
from autotune.diagnosis.selection.probability import Candidate
from autotune.effects import ALL, CATALOGUE, kind_of
from autotune.models import Block, Effect, Model, Parameter, Port, TransferFunction
from autotune.report.chain_diagram import chain_diagram
from autotune.report.diagnosis_page import write_diagnosis_page
from autotune.report.diagnosis_words import how_they_add_up
from autotune.report.effect_words import clause, of_candidate
from autotune.report.investigation_page import list_candidates
from autotune.report.law_figures import alike_once, file_names, style_of
from autotune.report.writing import join_clauses, number, with_spread
from tests.autotune.diagnosis.servo_rigs import GAIN, servo_model, servo_recording

LAG = TransferFunction(num=(1.0,), den=(1.0, 1.0))
PLACES = ("controller", "timing", "actuator", "plant", "sensor", "environment")
TEXT = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=40)


@pytest.mark.parametrize("name", [kind.name for kind in ALL])
def test_every_effect_of_the_catalogue_has_words(name: str) -> None:
    short, said = kind_of(name).words
    assert 0 < len(short) <= 20
    assert said[0].islower()
    assert not said.endswith(".")


@given(value=st.floats(-1e9, 1e9, allow_nan=False), digits=st.integers(2, 6))
def test_a_number_is_the_one_that_was_given_to_its_digits(value: float, digits: int) -> None:
    assert float(number(value, digits)) == pytest.approx(value, rel=0.51 * 10.0 ** (1 - digits), abs=1e-300)


def test_a_unit_that_is_none_is_not_written() -> None:
    assert with_spread(Parameter(value=170.4, sd=101.0, unit="-")) == "170.4 ± 198"
    assert with_spread(Parameter(value=0.25, unit="-/s")) == "0.25 1/s"


def test_a_number_ends_where_its_interval_does() -> None:
    assert with_spread(Parameter(value=0.0599823, sd=1.17e-5, unit="kg m^2")) == "0.059982 ± 0.000023 kg m²"
    assert with_spread(Parameter(value=-17.1523, sd=2.55, unit="V")) == "-17.2 ± 5.0 V"


@example(blocks=[("0", "actuator")] * 7, named={key: ["x"] for key in PLACES}, possible=[])
@given(
    blocks=st.lists(st.tuples(TEXT.filter(str.strip), st.sampled_from(PLACES[2:5])), min_size=1, max_size=7),
    named=st.dictionaries(st.sampled_from(PLACES), st.lists(TEXT, min_size=1, max_size=3)),
    possible=st.lists(st.sampled_from(PLACES), max_size=3),
)  # fmt: skip
def test_a_diagram_is_drawn_for_any_chain_and_says_each_place_that_is_lit(
    blocks: list[tuple[str, str]], named: Mapping[str, list[str]], possible: list[str]
) -> None:
    chain = tuple(Block(name=name, place=place, dynamics=LAG) for name, place in blocks)  # type: ignore[arg-type]
    model = Model(name="any", input=Port(unit="V"), output=Port(unit="m"), blocks=chain)
    drawn = ET.fromstring(f"<div>{chain_diagram(model, named, [p for p in possible if p not in named])}</div>")
    lying, upright = drawn
    for half in (lying, upright):
        boxes = list(half.iter("rect"))
        assert sum("lit" in one.attrib["class"] for one in boxes) == len(named)
        assert len(boxes) >= len(blocks) + 2
        assert all(float(one.attrib["width"]) > 0.0 for one in boxes)


def servo_diagnosis(without: tuple[str, ...] = ()) -> Diagnosis:
    drag = lambda x, v: -0.06 / GAIN * v * abs(v)  # noqa: E731 - a force, as the rig takes it
    recordings = [replace(servo_recording(s, drag), name=f"/data/monday/step_{s}.csv") for s in (1, 2)]
    return diagnose(servo_model(), recordings, without=without)


def page_of(found: Diagnosis, folder: Path) -> str:
    write_diagnosis_page(found, folder / "page.html")
    content = (folder / "page.html").read_text(encoding="utf-8")
    return re.sub(r"<(script|style)\b.*?</\1>", "", content, flags=re.S)


def test_a_page_says_the_law_in_words_and_shows_it_with_data_and_on_unseen_rows(tmp_path: Path) -> None:
    others = tuple(name for name in CATALOGUE if name != "plant.quadratic_drag")
    found = servo_diagnosis(others)
    assert [e.name for e in found.effects] == ["plant.quadratic_drag"]
    page = page_of(found, tmp_path)
    for said in (
        "drag grows with the square of the speed (plant.quadratic_drag, probability",
        "that no number was fitted to",
        "bins of the data agree with it",
        "step_1.csv",
        "What speaks against it",
        "beyond that nothing was excited",
        'class="lit"',
    ):
        assert said in page, said
    for unsaid in ("/data/monday", "Recording 0", "recording 0", "den[0]", "Nothing was added"):
        assert unsaid not in page, unsaid
    assert page.count("free run") >= 2
    # before and after stand in one table, and the extended model is the better one on rows that it was not fitted to
    stretch = {row[0]: float(row[1]) for row in re.findall(r"<td>(nominal|retuned|extended)</td><td>([\d.]+) %", page)}
    assert stretch["extended"] < 0.7 * stretch["retuned"]


def test_an_effect_in_the_extended_model_that_is_not_named_is_said_to_be_there(tmp_path: Path) -> None:
    found = servo_diagnosis(tuple(CATALOGUE))
    leak = Effect(name="plant.leak", parameters={"rate": Parameter(value=0.1, sd=0.01, unit="1/s")})
    within = replace(found, effects=(), extended_model=replace(found.extended_model, effects=(leak,)))
    page = page_of(within, tmp_path)
    assert "Nothing was added" not in page
    assert "The extended model has, beyond what is named: the plant loses what it has stored (plant.leak)" in page


def test_an_extended_model_without_what_was_found_is_not_said_to_have_it(tmp_path: Path) -> None:
    found = servo_diagnosis(tuple(CATALOGUE))
    assert not found.withheld
    withheld = replace(found, extended_model=servo_model(), withheld=WITHHELD[True])
    page = page_of(withheld, tmp_path)
    assert "extended_model.toml is the model as it was" in page
    assert "Go on with extended_model.toml" not in page


def test_a_structure_is_called_right_only_where_nothing_larger_than_noise_is_left() -> None:
    found = servo_diagnosis(tuple(CATALOGUE))
    evidence = ChainEvidence(
        model=servo_model(), search=found.search, samples=(), residual=found.residual, quality_of=lambda: found.fit,
        again=lambda *rest: pytest.fail("no part is asked"),
    )  # fmt: skip
    assert not found.residual.is_noise
    assert "structure is right" not in sentences_of("parameters", (), evidence, ())[0]
    down = replace(evidence, quality_of=lambda: replace(found.fit, extended=found.fit.noise_floor))
    assert "structure is right" in sentences_of("parameters", (), down, ())[0]


def test_rivals_are_told_in_words_with_their_names() -> None:
    said = of_candidate("plant.coulomb_friction+actuator.lag")
    assert said.startswith(clause("plant.coulomb_friction"))
    assert said.endswith("(plant.coulomb_friction + actuator.lag)")
    assert join_clauses(["a", "b", "c"]) == "a, b and c"


def test_beside_an_effect_that_no_hypothesis_has_nothing_else_is_missing() -> None:
    left = (("none", 0.95), ("unknown", 0.03))
    assert list_candidates(left, "effect").startswith("nothing else is missing 0.95")
    assert list_candidates(left, "none").startswith("nothing is missing 0.95")
    assert "nothing is missing 0.01" in list_candidates((("actuator.lag", 0.99), ("none", 0.01)), "effect")


def test_curves_that_run_alike_are_one_under_both_names_and_keep_a_gap_in_it() -> None:
    y = np.array([0.0, np.nan, 1.0])
    assert list(alike_once({"nominal": y + 1.0, "retuned": y, "extended": y.copy()})) == [
        "nominal",
        "retuned and extended",
    ]
    assert list(alike_once({"retuned": y, "extended": y + 1e-12})) == ["retuned", "extended"]
    assert style_of("retuned and extended") == style_of("extended")


def test_recordings_of_one_file_name_are_told_apart_by_their_folders() -> None:
    r = servo_recording(1, rows=120)
    assert file_names([replace(r, name="/a/mon/x.csv"), replace(r, name="/a/tue/x.csv")]) == ("mon/x.csv", "tue/x.csv")
    assert file_names([replace(r, name="/a/mon/x.csv"), replace(r, name="/a/mon/y.csv")]) == ("x.csv", "y.csv")


@pytest.mark.parametrize(("probability", "said"), [(0.97, "is the sum of those"), (0.82, "but for plant.hard_stop")])
def test_a_probability_that_parts_made_less_is_not_said_to_be_a_sum(probability: float, said: str) -> None:
    """Only one part of a recording may have met a stop: the explanations that have it then sum up to more."""
    effect = FoundEffect(name="plant.hard_stop", probability=probability, places=("plant",), parameters={}, equation="",
                         windows=())  # fmt: skip
    candidates = (Candidate(name="plant.hard_stop", probability=0.97), Candidate(name="unknown", probability=0.03))
    assert said in how_they_add_up((effect,), candidates)
