"""What is incomplete in an effect's record is refused, with what to add; the catalogue itself is complete."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import autotune
from autotune.effects import ALL, CATALOGUE, kind_of
from autotune.effects.base import EffectKind, Quantity, lacking
from autotune.effects.checks import require_complete
from autotune.effects.stages import Line, LinearPart, Memory
from autotune.errors import InputError


def dragged(v: float, coefficient: float) -> float:
    return -coefficient * v


def with_typing_error(v: float, coeficient: float) -> float:
    return -coeficient * v


DRAG = EffectKind(
    name="plant.viscous_drag",
    equation="force = -coefficient v",
    parameters=(Quantity(name="coefficient", unit="1", role="amplitude"),),
    reference="Newton",
    lines=(Line(stage="force", does=dragged),),
    starts=lambda sizes: [(1.0,)],
)


def test_a_complete_record_is_taken() -> None:
    require_complete((*ALL, DRAG))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"equation": " "}, "no equation; give equation a text"),
        ({"reference": ""}, "no reference"),
        ({"name": "elsewhere.drag"}, "no place 'elsewhere'"),
        ({"parameters": ()}, "no parameters"),
        ({"starts": kind_of("actuator.stiction").starts}, "no fit would ever start"),
        (
            {"starts": lambda sizes: [(1.0, 2.0)]},
            r"\(1.0, 2.0\) are not one for each.*values of coefficient",
        ),
        ({"starts": lambda sizes: [()]}, "not one for each parameter"),
        (
            {"parameters": (Quantity(name="coefficient", unit="{q}", role="amplitude"),)},
            r"unit '\{q\}'.*are \{u\}",
        ),
        ({"odds": lacking(usual="automobile")}, "no kind of rig: 'automobile'"),
        ({"lines": ()}, r"nothing would be simulated; add lines="),
        ({"lines": (Line(stage="force", does=with_typing_error),)}, "takes 'coeficient', which is neither a signal"),
        ({"lines": (Line(stage="nowhere", does=dragged),)}, "no stage 'nowhere'"),  # type: ignore[arg-type]
        ({"lines": (Line(stage="sensor", does=dragged),)}, "takes 'v', which is neither a signal of stage sensor"),
        ({"memory": Memory(name="held")}, "no line takes its memory 'held'"),
        ({"places": ("plant", "mars")}, "no place 'mars'"),
        ({"name": "plant.leak"}, "stands twice"),
        ({"parameters": (*DRAG.parameters, Quantity(name="idle", unit="", role="shape"))}, "'idle' acts nowhere"),
        ({"parameters": (Quantity(name="coefficient", unit="", role="knob"),)}, "no role 'knob'"),  # type: ignore[arg-type]
        ({"lines": (), "linear": LinearPart()}, "changes nothing"),
        ({"lines": (), "linear": LinearPart(blocks=lambda b, v: b, states=1)}, "without start"),
    ],
)
def test_what_is_missing_or_contradicts_itself_is_refused_by_name(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        require_complete((*ALL, replace(DRAG, **change)))


@pytest.mark.parametrize("left_out", ["name", "equation", "parameters", "reference", "lines", "starts"])
def test_an_incomplete_record_is_refused_when_the_package_is_imported(tmp_path: Path, left_out: str) -> None:
    """A record as a newcomer writes it into the file of its place, with one of its parts left out."""
    copy = tmp_path / "autotune"
    subprocess.run(["cp", "-r", str(Path(autotune.__file__).parent), str(copy)], check=True)
    place = copy / "effects" / "timing.py"
    parts = {
        "name": 'name="timing.slowness"', "equation": 'equation="w -> w (1 - share)"',
        "parameters": 'parameters=(Quantity(name="share", unit="1", role="amplitude"),)',
        "lines": 'lines=(Line(stage="command", does=slowed),)', "starts": "starts=lambda sizes: [(0.1,)]",
        "reference": 'reference="Newton"',
    }  # fmt: skip
    record = ", ".join(part for key, part in parts.items() if key != left_out)
    line = "def slowed(w: float, share: float) -> float:\n    return w * (1.0 - share)\n\n\n"
    text = place.read_text(encoding="utf-8").replace(
        "TIMING = (\n", f"{line}TIMING = (\n    EffectKind({record}),\n", 1
    )
    place.write_text(text, encoding="utf-8")
    found = subprocess.run(
        [sys.executable, "-c", "import autotune.effects"], cwd=tmp_path, capture_output=True, text=True
    )
    assert found.returncode != 0
    said = found.stderr.splitlines()[-1]
    what = {"lines": "nothing would be simulated", "starts": "no fit would ever start", "name": "'name'"}
    assert what.get(left_out, f"effect timing.slowness: no {left_out}") in said


def test_neutral_values_do_nothing() -> None:
    """Every line with all its parameters at their neutral values hands its signal on."""
    tried = 0
    for kind in ALL:
        values = {q.name: q.neutral for q in kind.parameters}
        if kind.memory is not None or any(value is None for value in values.values()):
            continue
        for line in kind.lines:
            signals = {"w": 0.7, "z": 0.7, "y": 0.7, "x": 0.7, "v": -0.2, "t": 3.0, "number": 1, "offset": 0.1,
                       "y_offset": 0.2}  # fmt: skip
            names = line.does.__code__.co_varnames[: line.does.__code__.co_argcount]
            out = line.does(**{name: values.get(name, signals.get(name)) for name in names})
            want = {"command": 0.7, "sensor": 0.7, "reading": 0.7, "stop": (0.7, -0.2), "load": 0.0}[line.stage]
            assert out == pytest.approx(want), kind.name
            tried += 1
    assert tried >= 4


def test_every_effect_that_is_searched_starts_somewhere_and_has_an_amplitude_or_several_starts() -> None:
    for kind in CATALOGUE.values():
        assert kind.search is not None or kind.starts.__name__ != "no_starts"
        assert all(q.neutral is None or not math.isnan(q.neutral) for q in kind.parameters)
