"""Equations as an FMU: co-simulation of FMI 3.0, of C source that needs no header but the compiler's own."""

from __future__ import annotations

import io
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
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


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A quantity of an FMU: its name, its unit as people write it, and what it begins with."""

    name: str
    unit: str
    start: float


@dataclass(frozen=True, kw_only=True)
class Description:
    """What an FMU has, in the order of its value references: inputs, states, y, parameters.

    Attributes
    ----------
    name : str
        Of the model.
    inputs, states, parameters : tuple of Variable
        Held between communication points; set before a run; tunable.
    output_unit : str
        Unit of y.
    """

    name: str
    inputs: tuple[Variable, ...]
    states: tuple[Variable, ...]
    output_unit: str
    parameters: tuple[Variable, ...]

    def to_xml(self, token: str) -> str:
        """Return modelDescription.xml, with the token that the library expects."""
        held, exact = 'causality="input"', 'causality="local" initial="exact"'
        tunable = 'causality="parameter" variability="tunable"'
        lines = ['<Float64 name="time" valueReference="0" causality="independent"/>']

        def add(name: str, unit: str, says: str) -> None:
            described = f" description={quoteattr(f'[{unit}]')}" if unit else ""
            lines.append(f'<Float64 name={quoteattr(name)} valueReference="{len(lines)}" {says}{described}/>')

        def begun(one: Variable) -> str:
            return f'start="{one.start!r}"'.replace("inf", "INF")  # as XML Schema writes it

        for one in self.inputs:
            add(one.name, one.unit, f"{held} {begun(one)}")
        for one in self.states:
            add(one.name, one.unit, f"{exact} {begun(one)}")
        y = len(lines)
        add("y", self.output_unit, 'causality="output" initial="calculated"')
        for one in self.parameters:
            add(one.name, one.unit, f"{tunable} {begun(one)}")
        variables = "\n    ".join(lines)
        return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName={quoteattr(self.name)} instantiationToken="{token}"
  generationTool="relay-autotune">
  <CoSimulation modelIdentifier="{_IDENTIFIER}" canHandleVariableCommunicationStepSize="true"/>
  <ModelVariables>
    {variables}
  </ModelVariables>
  <ModelStructure><Output valueReference="{y}"/><InitialUnknown valueReference="{y}"/></ModelStructure>
</fmiModelDescription>
"""


def _equations_in_c(flat: EquationModel, names: Mapping[str, str]) -> str:
    """Return the equations of a model without effects, and what runs them between communication points."""

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
    return "\n".join(equations) + _part("fmi3_equations.c")


def _part(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def whole_source(model: str) -> str:
    """Return the C source of an FMU from that of its model, with the functions by which FMI 3.0 runs it around it."""
    body = f"{_part('fmi3_types.c')}\n{model}\n{_part('fmi3.c')}"
    # the token tells this FMU from any other: the same for the same equations
    return f'#define TOKEN "{sha256(body.encode()).hexdigest()[:32]}"\n{body}'


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
    flat = flatten(model)
    names = safe_names(flat, _C_TAKEN)
    description = Description(
        name=flat.name,
        inputs=tuple(Variable(name=names[one.column], unit=one.unit, start=0.0) for one in flat.inputs),
        states=tuple(Variable(name=names[one.name], unit=one.unit, start=one.start or 0.0) for one in flat.states),
        output_unit=flat.output_unit,
        parameters=tuple(Variable(name=names[one.name], unit=one.unit, start=one.value) for one in flat.parameters),
    )
    return pack_fmu(whole_source(_equations_in_c(flat, names)), description)


def pack_fmu(source: str, description: Description) -> tuple[bytes, str]:
    """Return an FMU of C source, and the platform that it brings a library for; empty without a C compiler.

    Parameters
    ----------
    source : str
        Of :func:`whole_source`.
    description : Description
        What it has.
    """
    token = source.split('"', 2)[1]
    library, tuple_of_platform, suffix = _compiled(source)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", description.to_xml(token))
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
