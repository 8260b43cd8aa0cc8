"""Prints how the house stands, ``python -m tests.house``: lines, long files and functions, docstrings, words."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST_FILE, LONGEST_FUNCTION = 300, 60
COMPILED = re.compile(r"^@?(numba\.)?(njit|jit|vectorize|guvectorize|cfunc|in_place)\b")
COMMAND = re.compile(r"\.(command|callback)\(")  # its parameters are documented beside them, for --help


@dataclass(frozen=True)
class Routine:
    """A function or method: where it is, and what its docstring says."""

    place: str
    lines: int  # without the docstring, which is to be as long as its parameters ask for
    compiled: bool
    parameters: tuple[str, ...]  # of a public one that is called from Python; else none
    arrays: bool  # it takes or returns an array
    doc: str

    @property
    def undocumented(self) -> list[str]:
        """The parameters that the docstring's section on parameters does not name."""
        section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[\w ]*\n-{3,}$|\Z)", self.doc, re.M | re.S)
        heads = re.findall(r"^(\S[^:\n]*?)(?: ?:.*)?$", section[1], re.M) if section else []
        named = {name.strip(" *") for head in heads for name in head.split(",")}
        return [name for name in self.parameters if name not in named]

    @property
    def shaped(self) -> bool:
        """Whether the docstring mentions the shape of an array."""
        return bool(re.search(r"\([A-Za-z0-9_+\- ]+(, ?[A-Za-z0-9_+\- ]*)+\)|\bscalar\b", self.doc))


@dataclass
class Package:
    """What is counted of one package."""

    name: str
    lines: int = 0
    comments: int = 0
    long_files: list[str] = field(default_factory=list)
    routines: list[Routine] = field(default_factory=list)

    @property
    def long_functions(self) -> list[Routine]:
        """Functions that are too long, compiled kernels apart."""
        return [r for r in self.routines if r.lines > LONGEST_FUNCTION and not r.compiled]

    @property
    def public(self) -> list[Routine]:
        """Public functions of two or more parameters."""
        return [r for r in self.routines if len(r.parameters) >= 2]


def routines_of(tree: ast.AST, place: str, public: bool = True) -> Iterator[Routine]:
    """Yield every function of a syntax tree; what is within a function, or behind an underscore, is not public."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef):
            yield from routines_of(node, f"{place}:{node.name}", public and not node.name.startswith("_"))
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            marks = [ast.unparse(mark) for mark in node.decorator_list]
            a = node.args
            given = [*a.posonlyargs, *a.args, *([a.vararg] if a.vararg else []), *a.kwonlyargs]
            given += [a.kwarg] if a.kwarg else []
            names = tuple(arg.arg for arg in given if arg.arg not in ("self", "cls"))
            hidden = node.name.startswith("_") or "overload" in marks or any(COMMAND.search(mark) for mark in marks)
            kinds = [ast.unparse(kind) for arg in given if (kind := arg.annotation)]
            kinds += [ast.unparse(node.returns)] if node.returns else []
            doc = node.body[0] if ast.get_docstring(node) else None
            said = (doc.end_lineno or doc.lineno) - doc.lineno + 1 if doc else 0
            yield Routine(
                place=f"{place}:{node.name}",
                lines=(node.end_lineno or node.lineno) - node.lineno + 1 - said,
                compiled=any(COMPILED.match(mark) for mark in marks),
                parameters=names if public and not hidden else (),
                arrays=any("Array" in kind for kind in kinds),
                doc=ast.get_docstring(node) or "",
            )
            yield from routines_of(node, f"{place}:{node.name}", False)
        else:
            yield from routines_of(node, place, public)


def packages() -> dict[str, Package]:
    """Count every package of the product; the modules that lie directly in ``autotune`` are one."""
    counted: dict[str, Package] = {}
    for path in sorted(path for top in ("autotune", "drivers", "sim") for path in (ROOT / top).rglob("*.py")):
        parts = path.relative_to(ROOT).parts
        if "__pycache__" in parts:  # compiled simulations are kept there with their source
            continue
        name = "/".join(parts[:2]) if parts[0] == "autotune" and len(parts) > 2 else parts[0]
        package = counted.setdefault(name, Package(name))
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        package.lines += len(lines)
        package.comments += sum(line.lstrip().startswith("#") for line in lines)
        if len(lines) > LONGEST_FILE:
            package.long_files.append(f"{'/'.join(parts)} {len(lines)}")
        package.routines += routines_of(ast.parse(text), "/".join(parts))
    return counted


def main() -> None:
    """Print the table, and what the documents and the changelog say."""
    counted = packages()
    total = Package("total")
    for package in counted.values():
        total.lines, total.comments = total.lines + package.lines, total.comments + package.comments
        total.long_files += package.long_files
        total.routines += package.routines
    print(
        f"{'package':<28}{'lines':>7}{'files>300':>10}{'funcs>60':>9}{'documented':>12}{'shapes':>10}{'comments':>10}"
    )
    for p in [*counted.values(), total]:
        arrays = [r for r in p.public if r.arrays]
        documented = f"{sum(not r.undocumented for r in p.public)}/{len(p.public)}"
        shapes = f"{sum(r.shaped for r in arrays)}/{len(arrays)}"
        share = f"{100 * p.comments / max(p.lines, 1):.1f} %"
        print(
            f"{p.name:<28}{p.lines:>7}{len(p.long_files):>10}{len(p.long_functions):>9}{documented:>12}{shapes:>10}{share:>10}"
        )
    apart = sum(counted[f"autotune/{name}"].lines for name in ("diagnosis", "equations"))
    tool = sum(p.lines for p in counted.values() if p.name.startswith("autotune"))
    print(f"\nautotune without diagnosis and equations: {tool - apart} lines")
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    missing = [name for name in counted if f"`{name}`" not in page]
    print(f"docs/architecture.md names {len(counted) - len(missing)} of {len(counted)} packages", *missing)
    unreleased = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")[1]
    print(f"CHANGELOG.md, unreleased: {len(unreleased.split())} words")


if __name__ == "__main__":
    main()
