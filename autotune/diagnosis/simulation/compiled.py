"""The compiled simulation, written from the effects' records.

Each line of an effect is a plain function in its record. Its source is copied into one file together with the stages
that call it and the body in :mod:`autotune.diagnosis.simulation.kernel`. The file is named by a hash of its content: a
line that is changed or added is another file, which is compiled anew. (The compiler's own cache is keyed by one file
and does not notice a change in another that it calls.)
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import inspect
import math
import os
import sys
import tempfile
import textwrap
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

from autotune.arrays import FloatArray
from autotune.diagnosis.simulation import kernel, stages
from autotune.effects import ALL
from autotune.effects.base import EffectKind
from autotune.effects.stages import STAGES, Line, StageName
from autotune.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where the compiled simulation keeps what of an effect.

    Attributes
    ----------
    kinds : tuple of EffectKind
        Those that have lines; the position of one is that of its flag.
    slots : mapping
        Position of the value of a parameter, by effect and parameter.
    memories : mapping
        Position of what an effect remembers, by effect.
    """

    kinds: tuple[EffectKind, ...]
    slots: Mapping[tuple[str, str], int]
    memories: Mapping[str, int]

    def flag(self, name: str) -> int:
        """Return the position of an effect's flag, -1 for one without lines."""
        return self._flags.get(name, -1)

    @cached_property
    def _flags(self) -> dict[str, int]:
        return {kind.name: i for i, kind in enumerate(self.kinds)}


def layout_of(kinds: Sequence[EffectKind]) -> Layout:
    """Return the layout for effects."""
    lined = tuple(kind for kind in kinds if kind.lines)
    pairs = [(kind.name, q.name) for kind in lined for q in kind.parameters]
    remembering = [kind.name for kind in lined if kind.memory is not None]
    return Layout(
        kinds=lined,
        slots={pair: i for i, pair in enumerate(pairs)},
        memories={name: i for i, name in enumerate(remembering)},
    )


def source_of(kinds: Sequence[EffectKind]) -> str:
    """Return the source of the compiled simulation with the lines of effects.

    Parameters
    ----------
    kinds : sequence of EffectKind
        In the order in which they act.

    Raises
    ------
    InputError
        A line that uses more than ``math`` and functions of its own file.
    """
    layout = layout_of(kinds)
    written = {"begin", "MEMORIES", *STAGES}
    head = [node for node in ast.parse(inspect.getsource(stages)).body if not _defines(node, written)]
    body = [node for node in ast.parse(inspect.getsource(kernel)).body if not _is_preamble(node)]
    parts = [ast.unparse(ast.Module(body=head, type_ignores=[])), f"MEMORIES = {len(layout.memories)}"]
    copied: dict[str, str] = {}
    for kind in layout.kinds:
        for line in kind.lines:
            copied |= _copied(line.does, kind.name)
    parts += copied.values()
    parts.append(_begin(layout))
    parts += [_stage(name, layout) for name in STAGES]
    parts.append(ast.unparse(ast.Module(body=body, type_ignores=[])))
    return "\n\n\n".join(parts) + "\n"


def _defines(node: ast.stmt, names: set[str]) -> bool:
    if isinstance(node, ast.Assign):
        return any(isinstance(target, ast.Name) and target.id in names for target in node.targets)
    return isinstance(node, ast.FunctionDef) and node.name in names


def _is_preamble(node: ast.stmt) -> bool:
    """Whether a statement of the body has its place in the head, or stands for what is written here."""
    if isinstance(node, ast.ImportFrom):
        return node.module in ("__future__", stages.__name__)
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _label(function: Callable[..., object]) -> str:
    return f"{function.__module__.rpartition('.')[2]}_{function.__name__}"


class _Renamed(ast.NodeTransformer):
    """Gives a function and those it calls the names they have in the written file."""

    def __init__(self, names: Mapping[str, str]) -> None:
        self.names = names

    def visit_Name(self, node: ast.Name) -> ast.Name:
        return ast.Name(id=self.names.get(node.id, node.id), ctx=node.ctx)


def _copied(function: Callable[..., object], effect: str) -> dict[str, str]:
    """Return the source of a line, and of what it calls first, by the names they have in the written file."""
    found: dict[str, str] = {}
    names: dict[str, str] = {}
    used = inspect.getclosurevars(function)
    if used.nonlocals:
        raise _refused(effect, ", ".join(used.nonlocals))
    constants = []
    for name, value in used.globals.items():
        if value is math:
            continue
        if isinstance(value, types.FunctionType) and value.__module__ == function.__module__:
            found |= _copied(value, effect)
            names[name] = _label(value)
        elif isinstance(value, float | int):
            constants.append(f"    {name} = {value!r}")
        else:
            raise _refused(effect, name)
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    definition = tree.body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise InputError("a line is not a function of its own", where=f"effect {effect}", remedy="write it with def")
    definition.name = _label(function)
    definition.body = [*ast.parse(textwrap.dedent("\n".join(constants))).body, *definition.body]
    source = "@inlined\n" + ast.unparse(_Renamed(names).visit(definition))
    return found | {definition.name: source}


def _refused(effect: str, name: str) -> InputError:
    return InputError(
        f"its line uses {name}", where=f"effect {effect}", remedy="use math and functions of the same file alone"
    )


def _arguments(kind: EffectKind, line: Line, layout: Layout) -> Iterator[str]:
    for name in inspect.signature(line.does).parameters:
        if kind.memory is not None and name == kind.memory.name:
            yield f"effects.memory[{layout.memories[kind.name]}]"
        elif (kind.name, name) in layout.slots:
            yield f"effects.numbers[{kernel.NUMBERS + layout.slots[kind.name, name]}]"
        elif name in STAGES[line.stage].held:
            yield f"effects.numbers[{getattr(kernel, name.upper())}]"
        else:
            yield name


def _stage(name: StageName, layout: Layout) -> str:
    """Return the source of a stage: the lines of all effects there, one after the other."""
    stage = STAGES[name]
    head = f"@inlined\ndef {name}({', '.join((*stage.value, *stage.signals, 'effects'))}):"
    rows = [] if stage.value or name == "travel" else ["total = 0.0"]
    for i, kind in enumerate(layout.kinds):
        for line in kind.lines:
            if line.stage != name:
                continue
            call = f"{_label(line.does)}({', '.join(_arguments(kind, line, layout))})"
            takes = kind.memory is not None and kind.memory.name in inspect.signature(line.does).parameters
            kept = [f"effects.memory[{layout.memories[kind.name]}]"] if takes else []
            rows.append(f"if effects.acts[{i}]:  # {kind.name}")
            if stage.value or name == "travel":
                rows.append(f"    {', '.join((*stage.value, *kept))} = {call}")
            else:
                rows.append(f"    total += {call}")
    rows.append(f"return {', '.join(stage.value) or 'None'}" if stage.value or name == "travel" else "return total")
    return "\n".join((head, *(f"    {row}" for row in rows)))


def _begin(layout: Layout) -> str:
    rows = ["@inlined", "def begin(w, follows, carried, effects):"]
    for kind in layout.kinds:
        if kind.memory is None:
            continue
        place = layout.memories[kind.name]
        if kind.memory.start == "replay":
            rows.append(f"    effects.memory[{place}] = carried[{place}]")
        else:
            rows.append(f"    if not follows:\n        effects.memory[{place}] = {_start(kind)}")
    return "\n".join((*rows, "    return None"))


def _start(kind: EffectKind) -> str:
    return "w" if kind.memory is not None and kind.memory.start == "command" else "0.0"


#: What runs a simulation, see :func:`autotune.diagnosis.simulation.kernel.run`.
Run = Callable[..., FloatArray]


@cache
def compiled_run() -> Run:
    """Return the compiled simulation with all effects of the catalogue; compiled at its first call."""
    return run_of(ALL)


def run_of(kinds: Sequence[EffectKind]) -> Run:
    """Return the compiled simulation with the lines of effects.

    Parameters
    ----------
    kinds : sequence of EffectKind
        In the order in which they act.
    """
    source = source_of(kinds)
    name = f"simulation_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    path = _written(name, source)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError("cannot be imported", where=str(path), remedy="set NUMBA_CACHE_DIR to a folder you may write")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    run: Run = module.run
    return run


def _written(name: str, source: str) -> Path:
    """Write the source where compiled code is kept; another process may do the same at the same time."""
    for folder in _folders():
        path = folder / f"{name}.py"
        try:
            if path.exists() and path.read_text(encoding="utf-8") == source:
                return path
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            handle, draft = tempfile.mkstemp(dir=folder, suffix=".py")
            with os.fdopen(handle, "w", encoding="utf-8") as stream:
                stream.write(source)
            os.replace(draft, path)
        except OSError:
            continue
        return path
    path = Path(tempfile.mkdtemp(prefix="autotune-")) / f"{name}.py"
    path.write_text(source, encoding="utf-8")
    return path


def _folders() -> Iterator[Path]:
    """Yield where the written file may be kept, as the compiler keeps its own: as told, beside this file, per user."""
    told = os.environ.get("NUMBA_CACHE_DIR")
    if told:
        yield Path(told) / "autotune"
        return
    yield Path(__file__).parent / "__pycache__"
    yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "autotune"
