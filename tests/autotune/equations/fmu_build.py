"""FMUs of FMI 2.0 and 3.0 built from C source: the compiler of this machine, the headers that FMPy brings."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from pathlib import Path

import fmpy

HERE = Path(__file__).parent
NAMES = ("u", "load", "phi", "w", "J", "c", "k", "der(phi)", "der(w)")
CAUSALITY = {
    "u": 'causality="input"', "load": 'causality="input"', "phi": 'causality="output"',
    **dict.fromkeys(("J", "c", "k"), 'causality="parameter" variability="tunable"'),
}  # fmt: skip
START = {"u": 0.0, "load": 0.0, "J": 0.05, "c": 0.1, "k": 1.0}


def description(kinds: tuple[str, ...]) -> str:
    """Return the model description for co-simulation, model exchange or both."""
    variables = []
    for reference, name in enumerate(NAMES):
        derivative = {"der(phi)": ' derivative="3"', "der(w)": ' derivative="4"'}.get(name, "")
        is_state = name in ("phi", "w")
        start = f' start="{START.get(name, 0.0)}"' if name in START or is_state else ""
        says = CAUSALITY.get(name, "") + (' initial="exact"' if is_state else "")
        variables.append(
            f'<ScalarVariable name="{name}" valueReference="{reference}" {says}><Real{start}{derivative}/>'
            "</ScalarVariable>"
        )
    attributes = {"CoSimulation": ' canHandleVariableCommunicationStepSize="true"', "ModelExchange": ""}
    offered = "".join(f'<{kind} modelIdentifier="rig"{attributes[kind]}/>' for kind in kinds)
    unknown = '<Unknown index="8"/><Unknown index="9"/>'
    return (
        '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="rig" guid="{rig}" '
        f'numberOfEventIndicators="0">{offered}<ModelVariables>{"".join(variables)}</ModelVariables><ModelStructure>'
        f'<Outputs><Unknown index="3"/></Outputs><Derivatives>{unknown}</Derivatives></ModelStructure>'
        "</fmiModelDescription>"
    )


def description_3(kinds: tuple[str, ...]) -> str:
    """Return the model description of FMI 3.0 for co-simulation, model exchange or both."""
    attributes = {"CoSimulation": ' canHandleVariableCommunicationStepSize="true"', "ModelExchange": ""}
    offered = "".join(f'<{kind} modelIdentifier="rig"{attributes[kind]}/>' for kind in kinds)
    variables = []
    for reference, name in enumerate(NAMES):
        derivative = {"der(phi)": ' derivative="2"', "der(w)": ' derivative="3"'}.get(name, "")
        is_state = name in ("phi", "w")
        start = f' start="{START.get(name, 0.0)}"' if name in START or is_state else ""
        says = CAUSALITY.get(name, "") + (' initial="exact"' if is_state else "")
        variables.append(f'<Float64 name="{name}" valueReference="{reference}" {says}{start}{derivative}/>')
    return (
        '<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="3.0" modelName="rig" '
        f'instantiationToken="{{rig}}">{offered}<ModelVariables>{"".join(variables)}</ModelVariables>'
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
