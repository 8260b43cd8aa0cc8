"""Plants that are nobody's rig, and so stand with the tests, are as independent a truth as those of ``sim``."""

import ast
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
PLANTS = [*FOLDER.glob("textbook/*.py"), FOLDER / "valve_loop.py", FOLDER / "valve_cases.py"]


@pytest.mark.parametrize("file", PLANTS, ids=lambda file: file.name)
def test_a_plant_shares_no_code_with_what_it_tests(file: Path) -> None:
    imports = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = [name for node in imports for name in (*(alias.name for alias in node.names), getattr(node, "module", ""))]
    assert not [name for name in names if name.split(".")[0] in ("autotune", "drivers")]
