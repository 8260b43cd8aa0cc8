"""FMUs of FMI 2.0 and 3.0 built from C source: the compiler of this machine, the headers that FMPy brings."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from pathlib import Path

import fmpy

HERE = Path(__file__).parent
NAMES = ("u", "load", "phi", "w", "J", "c", "k", "der(phi)", "der(w)")
CAUSALITY = {
    "u": 'causality="input"', "load": 'causality="input"', "phi": 'causality="output"',
    **dict.fromkeys(("J", "c", "k"), 'causality="parameter" variability="tunable"'),
}  # fmt: skip
START = {"u": 0.0, "load": 0.0, "J": 0.05, "c": 0.1, "k": 1.0}


def variables_of(**states: int) -> Iterator[tuple[str, str]]:
    """Yield what every variable is, and its start and derivative; each state's index is as its derivative names it."""
    for reference, name in enumerate(NAMES):
        derived = {f"der({state})": f' derivative="{index}"' for state, index in states.items()}.get(name, "")
        start = f' start="{START.get(name, 0.0)}"' if name in START or name in states else ""
        says = CAUSALITY.get(name, "") + (' initial="exact"' if name in states else "")
        yield f'name="{name}" valueReference="{reference}" {says}', start + derived


def offered_as(kinds: tuple[str, ...]) -> str:
    """Return the elements that say by which interfaces the model is offered."""
    attributes = {"CoSimulation": ' canHandleVariableCommunicationStepSize="true"', "ModelExchange": ""}
    return "".join(f'<{kind} modelIdentifier="rig"{attributes[kind]}/>' for kind in kinds)


def description(kinds: tuple[str, ...]) -> str:
    """Return the model description for co-simulation, model exchange or both."""
    variables = [f"<ScalarVariable {says}><Real{value}/></ScalarVariable>" for says, value in variables_of(phi=3, w=4)]
    unknown = '<Unknown index="8"/><Unknown index="9"/>'
    return (
        '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="rig" guid="{rig}" '
        f'numberOfEventIndicators="0">{offered_as(kinds)}<ModelVariables>{"".join(variables)}</ModelVariables><ModelStructure>'
        f'<Outputs><Unknown index="3"/></Outputs><Derivatives>{unknown}</Derivatives></ModelStructure>'
        "</fmiModelDescription>"
    )


def description_3(kinds: tuple[str, ...]) -> str:
    """Return the model description of FMI 3.0 for co-simulation, model exchange or both."""
    variables = [f"<Float64 {says}{value}/>" for says, value in variables_of(phi=2, w=3)]
    return (
        '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="3.0" modelName="rig" '
        f'instantiationToken="{{rig}}">{offered_as(kinds)}<ModelVariables>{"".join(variables)}</ModelVariables>'
        '<ModelStructure><Output valueReference="2"/>'
        '<ContinuousStateDerivative valueReference="7"/><ContinuousStateDerivative valueReference="8"/>'
        "</ModelStructure></fmiModelDescription>"
    )


def build(folder: Path, *kinds: str, fmi: int = 2) -> Path:
    """Return an FMU of FMI 2.0 or 3.0 that was compiled into a folder."""
    headers, source = Path(fmpy.__file__).parent / "c-code", HERE / ("rig_fmu3.c" if fmi == 3 else "rig_fmu.c")
    library = folder / f"rig{fmpy.sharedLibraryExtension}"
    compiler = shutil.which("cc") or shutil.which("gcc") or "cc"
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O2", "-w", f"-I{headers}", str(source), "-lm", "-o", str(library)], check=True
    )
    fmu = folder / "rig.fmu"
    with zipfile.ZipFile(fmu, "w") as archive:
        offered = kinds or ("CoSimulation",)
        archive.writestr("modelDescription.xml", description_3(offered) if fmi == 3 else description(offered))
        archive.write(library, f"binaries/{fmpy.platform_tuple if fmi == 3 else fmpy.platform}/{library.name}")
    return fmu
