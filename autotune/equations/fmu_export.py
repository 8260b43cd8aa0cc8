"""Equations as an FMU: co-simulation of FMI 3.0, of C source that needs no header but the compiler's own."""

from __future__ import annotations

import io
import platform
import shutil
import subprocess
import tempfile
import zipfile
from hashlib import sha256
from pathlib import Path
from xml.sax.saxutils import quoteattr

from autotune.equations.exports import Language, safe_names
from autotune.equations.flatten import flatten
from autotune.equations.model import EquationModel
from autotune.errors import InputError

_IDENTIFIER = "rig"
#: FMI's names of systems and of processors, and what a shared library is called there.
_SYSTEMS = {"Linux": ("linux", ".so"), "Darwin": ("darwin", ".dylib"), "Windows": ("windows", ".dll")}
_PROCESSORS = {"x86_64": "x86_64", "AMD64": "x86_64", "aarch64": "aarch64", "arm64": "aarch64"}
_C = Language(
    constants={"pi": "3.141592653589793", "t": "t"},
    conditional="({condition} ? {then} : {otherwise})",
    power="pow({base}, {exponent})",
    functions={"abs": "fabs", "min": "fmin", "max": "fmax", "sign": "sign_of"},
)
_C_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while t x in p dx "
    "time y fabs fmin fmax pow sign_of main "
)
_C_TAKEN = frozenset(_C_WORDS.split())


def as_c(model: EquationModel) -> str:
    """Return the C source of an FMU: the model's equations, and the functions by which FMI 3.0 runs them."""
    flat = flatten(model)
    names = safe_names(flat, _C_TAKEN)

    def numbers(values: list[float]) -> str:
        return "{" + ", ".join(repr(float(value)) for value in (*values, 0.0)) + "}"

    unpacked = [
        f"    const double {names[name]} = {array}[{i}];"
        for array, known in (("x", flat.state_names), ("in", flat.columns), ("p", flat.parameter_names))
        for i, name in enumerate(known)
    ]
    unpacked += [f"    const double {names[name]} = {_C.spell(tree, names)};" for name, tree in flat.defines]
    given = "double t, const double *x, const double *in, const double *p"
    equations = [
        f"enum {{ STATES = {len(flat.states)}, INPUTS = {len(flat.inputs)}, PARAMETERS = {len(flat.parameters)} }};",
        f"static const double X_0[] = {numbers([one.start or 0.0 for one in flat.states])};",
        f"static const double IN_0[] = {numbers([0.0 for _ in flat.inputs])};",
        f"static const double P_0[] = {numbers([one.value for one in flat.parameters])};",
        f"static const double DELAYS[] = {numbers([one.delay_s for one in flat.inputs])};", "",
        "static double sign_of(double value) { return (value > 0.0) - (value < 0.0); }", "",
        f"static void derivatives({given}, double *dx)", "{", *unpacked,
        *(f"    dx[{i}] = {_C.spell(one.derivative, names)};" for i, one in enumerate(flat.states)), "}", "",
        f"static double output({given})", "{", *unpacked, f"    return {_C.spell(flat.output, names)};", "}", "",
    ]  # fmt: skip
    body = "\n".join(equations) + Path(__file__).with_name("fmi3.c").read_text(encoding="utf-8")
    return f'#include <math.h>\n#define TOKEN "{_token(body)}"\n{body}'


def _token(body: str) -> str:
    """Return what tells this FMU from any other: the same for the same equations."""
    return sha256(body.encode()).hexdigest()[:32]


def description_of(model: EquationModel, token: str) -> str:
    """Return modelDescription.xml.

    Parameters
    ----------
    model : EquationModel
        With its effects.
    token : str
        That the library expects.
    """
    flat = flatten(model)
    names = safe_names(flat, _C_TAKEN)
    held, exact = 'causality="input"', 'causality="local" initial="exact"'
    tunable = 'causality="parameter" variability="tunable"'
    lines = ['<Float64 name="time" valueReference="0" causality="independent"/>']

    def add(name: str, unit: str, says: str) -> None:
        described = f" description={quoteattr(f'[{unit}]')}" if unit else ""
        lines.append(f'<Float64 name={quoteattr(name)} valueReference="{len(lines)}" {says}{described}/>')

    for one in flat.inputs:
        add(names[one.column], one.unit, f'{held} start="0.0"')
    for state in flat.states:
        add(names[state.name], state.unit, f'{exact} start="{state.start or 0.0!r}"')
    y = len(lines)
    add("y", flat.output_unit, 'causality="output" initial="calculated"')
    for known in flat.parameters:
        add(names[known.name], known.unit, f'{tunable} start="{known.value!r}"')
    variables = "\n    ".join(lines)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName={quoteattr(flat.name)} instantiationToken="{token}"
  generationTool="relay-autotune">
  <CoSimulation modelIdentifier="{_IDENTIFIER}" canHandleVariableCommunicationStepSize="true"/>
  <ModelVariables>
    {variables}
  </ModelVariables>
  <ModelStructure><Output valueReference="{y}"/><InitialUnknown valueReference="{y}"/></ModelStructure>
</fmiModelDescription>
"""


_BUILD = f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="{_IDENTIFIER}">
    <SourceFileSet language="C99"><SourceFile name="{_IDENTIFIER}.c"/></SourceFileSet>
    <Library name="m" external="true"/>
  </BuildConfiguration>
</fmiBuildDescription>
"""


def as_fmu(model: EquationModel) -> tuple[bytes, str]:
    """Return an FMU, and the platform that it brings a library for; empty where this machine has no C compiler.

    Parameters
    ----------
    model : EquationModel
        Its effects are written out, its parameters tunable, its states' starts may be set.

    Notes
    -----
    Terms that switch are stepped over with a ten-thousandth of a communication step at the shortest, where the
    project's own simulation locates them.

    References
    ----------
    Modelica Association, Functional Mock-up Interface Specification 3.0, 2022, sections 2.4, 2.5 and 4.
    """
    source = as_c(model)
    token = source.split('"', 2)[1]
    library, tuple_of_platform, suffix = _compiled(source)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", description_of(model, token))
        archive.writestr("sources/buildDescription.xml", _BUILD)
        archive.writestr(f"sources/{_IDENTIFIER}.c", source)
        if library:
            archive.writestr(f"binaries/{tuple_of_platform}/{_IDENTIFIER}{suffix}", library)
    return content.getvalue(), tuple_of_platform if library else ""


def _compiled(source: str) -> tuple[bytes, str, str]:
    """Return the library that this machine's compiler makes, FMI's name of the platform, and the library's suffix."""
    system, suffix = _SYSTEMS.get(platform.system(), ("", ""))
    processor, compiler = _PROCESSORS.get(platform.machine(), ""), shutil.which("cc") or shutil.which("gcc")
    if not (system and processor and compiler):
        return b"", "", ""
    with tempfile.TemporaryDirectory() as folder:
        code, library = Path(folder) / f"{_IDENTIFIER}.c", Path(folder) / f"{_IDENTIFIER}{suffix}"
        code.write_text(source, encoding="utf-8")
        done = subprocess.run(
            [compiler, "-std=c99", "-O2", "-fPIC", "-shared", str(code), "-lm", "-o", str(library)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            raise InputError(
                f"the C compiler refuses the model: {done.stderr.strip().splitlines()[0]}", where=compiler,
                remedy="take another compiler, or name what it names otherwise",
            )  # fmt: skip
        return library.read_bytes(), f"{processor}-{system}", suffix
