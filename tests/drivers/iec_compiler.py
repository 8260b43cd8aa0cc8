"""Function blocks through a real IEC 61131-3 compiler (matiec) and GCC, as libraries of this computer."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

_BESIDE = Path(__file__).resolve().parents[3] / "shared" / "tools" / "matiec" / "iec2c"
_NUMBERS = ("BOOL", "INT", "DINT", "REAL", "LREAL")


def iec2c() -> Path:
    """Return the compiler: named by IEC2C, on the path, or beside the checkout; its library lies in lib beside it."""
    named = os.environ.get("IEC2C") or shutil.which("iec2c") or (str(_BESIDE) if _BESIDE.exists() else None)
    if named is None:
        say = pytest.fail if os.environ.get("REQUIRE_SYSTEM_PACKAGES") else pytest.skip
        say("needs the IEC 61131-3 compiler matiec: IEC2C=/path/to/iec2c, or iec2c on PATH")
    compiler = Path(named).resolve()
    assert (compiler.parent / "lib" / "C").is_dir(), f"{compiler} has no lib/C beside it"
    return compiler


def generated_c(source: str, folder: Path) -> Path:
    """Compile Structured Text to C into a folder, and return the folder of the headers that the C includes.

    Raises
    ------
    AssertionError
        With the compiler's messages.
    """
    compiler = iec2c()
    folder.mkdir(parents=True, exist_ok=True)
    text = folder / "source.st"
    text.write_text(source)
    command = [compiler, "-p", "-I", compiler.parent / "lib", "-T", folder, text]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return compiler.parent / "lib" / "C"


def library(sources: Iterable[Path], headers: Path, out: Path) -> ctypes.CDLL:
    """Build C that the compiler wrote into a library."""
    flags = ["-O1", "-ffp-contract=off", "-shared", "-fPIC", "-w"]
    subprocess.run(["gcc", *flags, f"-I{headers}", f"-I{out.parent}", "-o", out, *sources, "-lm"], check=True)
    return ctypes.CDLL(str(out))


_GLOBALS = """
#include <stdlib.h>
#include "POUS.h"
TIME __CURRENT_TIME;
BOOL __DEBUG = 0;
#include "POUS.c"
"""


class Blocks:
    """Function blocks, compiled.

    Parameters
    ----------
    source : str
        Structured Text.
    folder : Path
        Where it is built.
    """

    def __init__(self, source: str, folder: Path) -> None:
        headers = generated_c(source, folder)
        blocks = re.findall(r"typedef struct \{(.*?)\} (\w+);", (folder / "POUS.h").read_text(), re.DOTALL)
        self.types = {
            name: {v: kind for kind, v in re.findall(r"__DECLARE_VAR\((\w+),(\w+)\)", body) if kind in _NUMBERS}
            for body, name in blocks
        }
        self.arrays = {name: re.findall(r"__DECLARE_VAR\(__ARRAY_OF_LREAL_\d+,(\w+)\)", body) for body, name in blocks}
        shim = folder / "shim.c"
        shim.write_text(_GLOBALS + "".join(self._shim(name) for name in self.types))
        self._library = library([shim], headers, folder / "blocks.so")

    def _shim(self, block: str) -> str:
        lines = [
            f"{block} *{block}_new(void) {{ {block} *d = calloc(1, sizeof *d); {block}_init__(d, 0); return d; }}",
            f"void {block}_cycle({block} *d) {{ {block}_body__(d); }}",
        ]
        for name in self.types[block]:
            lines.append(f"void {block}_set_{name}({block} *d, double v) {{ d->{name}.value = v; }}")
            lines.append(f"double {block}_get_{name}({block} *d) {{ return d->{name}.value; }}")
        for name in self.arrays[block]:
            lines.append(f"void {block}_put_{name}({block} *d, int i, double v) {{ d->{name}.value.table[i] = v; }}")
            lines.append(f"double {block}_at_{name}({block} *d, int i) {{ return d->{name}.value.table[i]; }}")
        return "\n".join(lines) + "\n"

    def call(self, block: str, what: str, *arguments: Any, returns: Any = None) -> Any:
        """Call a function of the shim."""
        function = getattr(self._library, f"{block}_{what}")
        function.restype = returns
        return function(*arguments)


class CompiledInstance:
    """An instance of a compiled function block, used like the interpreted one."""

    def __init__(self, name: str, blocks: Blocks) -> None:
        self._name, self._blocks = name, blocks
        self._it = ctypes.c_void_p(blocks.call(name, "new", returns=ctypes.c_void_p))
        self.value = _Values(self._name, self._blocks, self._it)

    def __call__(self, **inputs: Any) -> CompiledInstance:
        """Set inputs and run one cycle."""
        for name, value in inputs.items():
            self.value[name] = value
        self._blocks.call(self._name, "cycle", self._it)
        return self

    def put(self, name: str, numbers: Iterable[float]) -> None:
        """Set an array."""
        for i, number in enumerate(numbers):
            self._blocks.call(self._name, f"put_{name}", self._it, i, ctypes.c_double(number))

    def numbers(self, name: str, count: int) -> list[float]:
        """Return an array's first numbers."""
        call, it = self._blocks.call, self._it
        return [call(self._name, f"at_{name}", it, i, returns=ctypes.c_double) for i in range(count)]


class _Values:
    """Variables by name, each in the Python type that its own type has."""

    def __init__(self, block: str, blocks: Blocks, it: ctypes.c_void_p) -> None:
        self._block, self._blocks, self._it = block, blocks, it

    def __getitem__(self, name: str) -> Any:
        value = self._blocks.call(self._block, f"get_{name}", self._it, returns=ctypes.c_double)
        return {"BOOL": bool, "INT": int, "DINT": int}.get(self._blocks.types[self._block][name], float)(value)

    def __setitem__(self, name: str, value: Any) -> None:
        self._blocks.call(self._block, f"set_{name}", self._it, ctypes.c_double(value))
