"""FMUs as models: FMI 2.0 and 3.0, co-simulation and model exchange, run with FMPy.

The model file names the FMU, its inputs by the recording's columns, the output, and the parameters to retune::

    fmu = "rig.fmu"
    [[input]]
    column = "u"
    variable = "voltage"          # optional; the column's name by default
    [output]
    value = "angle"
    [parameters.J]
    value = 0.05                  # optional; the FMU's start value by default
"""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.black_box import BlackBox
from autotune.equations.read import input_of, parameter_of
from autotune.equations.simulate import Drive
from autotune.errors import InputError
from autotune.model_tables import effect_of, require_keys

_KEYS = {"name", "fmu", "input", "output", "parameters", "effect"}


def _fmpy() -> Any:
    try:
        import fmpy
    except ImportError:
        raise InputError("FMPy is not installed", where="FMU", remedy="pip install 'relay-autotune[fmu]'") from None
    return fmpy


def _description(path: Path) -> Any:
    """Return an FMU's model description.

    Raises
    ------
    InputError
        No FMU, or one for another platform.
    """
    fmpy = _fmpy()
    if not path.is_file():
        raise InputError("no such file", where=str(path), remedy="check the path")
    try:
        description = fmpy.read_model_description(str(path), validate=False)
        platforms = fmpy.supported_platforms(str(path))
    except Exception as error:  # FMPy passes on what its parsers raise
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"is no FMU that can be read ({what})", where=str(path), remedy="export it again") from None
    if fmpy.platform not in platforms and fmpy.platform_tuple not in platforms:
        raise InputError(
            f"was built for {', '.join(platforms) or 'no platform'}, this is {fmpy.platform}", where=str(path),
            remedy="export it for this platform, or with its sources and compile it by fmpy",
        )  # fmt: skip
    if not str(description.fmiVersion).startswith(("2.", "3.")):
        raise InputError(f"is of FMI {description.fmiVersion}", where=str(path), remedy="export it as FMI 2.0 or 3.0")
    return description


def fmu_of(content: Mapping[str, Any], where: str) -> BlackBox:
    """Return the model that a file's content states; the FMU's path counts from the file's folder.

    Parameters
    ----------
    content : mapping
        The decoded TOML.
    where : str
        Its file, for messages and for the FMU's path.

    Raises
    ------
    InputError
        An FMU that cannot be used, or a variable that it does not have.
    """
    require_keys(content, _KEYS, where)
    path = (Path(where).parent / str(content["fmu"])).resolve()
    description = _description(path)
    known = {v.name: v for v in description.modelVariables}
    tables = content.get("input", [])
    if not isinstance(tables, list) or not tables:
        raise InputError("no [[input]]", where=where, remedy='name the command: [[input]] column = "u"')
    inputs, variables = [], []
    for i, table in enumerate(tables, 1):
        plain = {k: v for k, v in table.items() if k != "variable"}
        inputs.append(input_of(plain, f"{where} [[input]] {i}"))
        variables.append(str(table.get("variable", inputs[-1].column)))
        _require(known, variables[-1], "input", f"{where} [[input]] {i}")
    output = content.get("output", {})
    value = str(output.get("value", ""))
    _require(known, value, None, f"{where} [output]")
    parameters = []
    for name, table in content.get("parameters", {}).items():
        _require(known, name, "parameter", f"{where} [parameters.{name}]")
        given = dict(table) if isinstance(table, dict) else {"value": table}
        if "value" not in given:
            given["value"] = _start(known[name], path) if known[name].start else 0.0
        parameters.append(parameter_of(name, given, where))
    return BlackBox(
        name=str(content.get("name", Path(where).stem)),
        inputs=tuple(inputs),
        parameters=tuple(parameters),
        simulation=FmuSimulation(path, tuple(variables), value),
        output_unit=str(output.get("unit", "")),
        effects=tuple(effect_of(t, f"{where} [[effect]] {i + 1}") for i, t in enumerate(content.get("effect", []))),
        source={"fmu": str(content["fmu"]), "variables": tuple(variables), "value": value},
    )


def _require(known: Mapping[str, Any], name: str, causality: str | None, where: str) -> None:
    if name in known and (causality is None or str(known[name].causality) == causality or (
        causality == "parameter" and str(known[name].variability) in ("fixed", "tunable")
    )):  # fmt: skip
        return
    offered = [n for n, v in known.items() if causality is None or str(v.causality) == causality][:12]
    kind = causality or "variable"
    raise InputError(f"the FMU has no {kind} {name!r}", where=where, remedy=f"it has {', '.join(offered) or 'none'}")


def template(path: Path) -> dict[str, Any]:
    """Return a model file's content for an FMU: all its inputs, its first output, its tunable parameters.

    Raises
    ------
    InputError
        An FMU that cannot be used, or that has no input or output.
    """
    description = _description(path)
    by = {c: [v for v in description.modelVariables if str(v.causality) == c] for c in ("input", "output", "parameter")}
    if not by["input"] or not by["output"]:
        raise InputError("has no input or no output", where=str(path), remedy="declare them in the tool that made it")
    inputs: list[dict[str, Any]] = [
        {"column": "u" if i == 0 else v.name, "variable": v.name} for i, v in enumerate(by["input"])
    ]
    for table in inputs:
        if table["column"] == table["variable"]:
            del table["variable"]
    parameters = {v.name: {"value": _start(v, path)} for v in by["parameter"] if _is_real(v) and v.start is not None}
    return {
        "name": str(description.modelName), "fmu": path.name, "input": inputs,
        "output": {"value": by["output"][0].name}, "parameters": parameters,
    }  # fmt: skip


def _start(variable: Any, path: Path) -> float:
    try:
        value = float(variable.start)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(
            f"start = {str(variable.start)[:40]!r} of {variable.name!r} is no number", where=str(path),
            remedy="declare it in the tool that made it",
        )  # fmt: skip
    return value


def _is_real(variable: Any) -> bool:
    return str(variable.type) in ("Real", "Float64", "Float32")


class FmuSimulation:
    """Runs an FMU over a recording's rows; it is unpacked and loaded once."""

    def __init__(self, path: Path, variables: tuple[str, ...], value: str) -> None:
        fmpy = _fmpy()
        self._description = _description(path)
        self._folder = tempfile.mkdtemp(prefix="fmu_")
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        fmpy.extract(str(path), unzipdir=self._folder)
        self._variables, self._value, self._path = variables, value, path
        self._references = {v.name: v.valueReference for v in self._description.modelVariables}
        self._slave: Any = None
        self._is_loadable = False

    def __call__(self, parameters: Mapping[str, float], drive: Drive) -> FloatArray:
        """Return y at the drive's rows."""
        self._require_library()
        try:
            if self._description.coSimulation is not None:
                return self._step_rows(parameters, drive)
            return self._integrate(parameters, drive)
        except InputError:
            raise
        except Exception as error:  # an FMU fails with whatever its maker's code does
            raise InputError(f"the FMU fails: {error}", where=str(self._path), remedy="check its parameters") from None

    def _require_library(self) -> None:
        """Refuse an FMU whose compiled code the system does not load; FMPy's error would be taken for the model's."""
        if self._is_loadable:
            return
        fmpy = _fmpy()
        form = self._description.coSimulation or self._description.modelExchange
        platform = fmpy.platform_tuple if str(self._description.fmiVersion).startswith("3.") else fmpy.platform
        name = f"binaries/{platform}/{form.modelIdentifier}{fmpy.sharedLibraryExtension}"
        library = Path(self._folder, name)
        # code that was cut short can end the process that loads it
        command = [sys.executable, "-I", "-S", "-c", "import ctypes, sys; ctypes.CDLL(sys.argv[1])", str(library)]
        tried = subprocess.run(command, capture_output=True, text=True, check=False, errors="replace")
        if tried.returncode:
            said = (tried.stderr.strip().splitlines() or [""])[-1].removeprefix(f"OSError: {library}: ")
            what = "it is missing" if not library.exists() else "it is damaged" if tried.returncode < 0 else said
            raise InputError(
                f"its compiled code {name} cannot be loaded ({what})", where=str(self._path),
                remedy="copy or export the FMU again, or install the library that it needs",
            )  # fmt: skip
        self._is_loadable = True

    def _step_rows(self, parameters: Mapping[str, float], drive: Drive) -> FloatArray:
        """Run a co-simulation FMU: its own solver from row to row, inputs held."""
        is_3 = str(self._description.fmiVersion).startswith("3.")
        slave = self._open_slave(is_3)
        references = self._references
        if not is_3:
            slave.setupExperiment(startTime=0.0)
        set_values = slave.setFloat64 if is_3 else slave.setReal
        get_values = slave.getFloat64 if is_3 else slave.getReal
        if parameters:
            set_values([references[n] for n in parameters], [float(v) for v in parameters.values()])
        inputs, output = [references[name] for name in self._variables], [references[self._value]]
        wanted, begins, lengths = drive.inputs.tolist(), (drive.t - drive.t[0]).tolist(), np.diff(drive.t).tolist()
        set_values(inputs, held := wanted[0])
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        y = get_values(output)
        for values, begin, length in zip(wanted, begins, lengths, strict=False):  # no step follows the last row
            if values != held:  # an FMU keeps its inputs, and a call takes as long as a step
                set_values(inputs, held := values)
            slave.doStep(currentCommunicationPoint=begin, communicationStepSize=length)
            y += get_values(output)
        return np.array(y, dtype=np.float64)

    def _open_slave(self, is_3: bool) -> Any:
        """Return the FMU reset, instantiated on first use."""
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        if self._slave is None:
            kind = FMU3Slave if is_3 else FMU2Slave
            self._slave = kind(
                guid=self._description.guid if not is_3 else self._description.instantiationToken,
                unzipDirectory=self._folder, instanceName="rig",
                modelIdentifier=self._description.coSimulation.modelIdentifier,
            )  # fmt: skip
            self._slave.instantiate()
            weakref.finalize(self, _free, self._slave)
        else:
            self._slave.reset()
        return self._slave

    def _integrate(self, parameters: Mapping[str, float], drive: Drive) -> FloatArray:
        """Run a model-exchange FMU with FMPy's solver; a held input is two rows at each change."""
        fmpy = _fmpy()
        t = drive.t - drive.t[0]
        held = np.repeat(np.arange(t.size), 2)[:-1]
        names = [("time", np.float64), *((name, np.float64) for name in self._variables)]
        signals = np.empty(held.size, dtype=names)
        signals["time"] = t[np.repeat(np.arange(t.size), 2)[1:]]
        for j, name in enumerate(self._variables):
            signals[name] = drive.inputs[held, j]
        result = fmpy.simulate_fmu(
            self._folder, model_description=self._description, start_time=0.0, stop_time=float(t[-1]),
            start_values={**dict(parameters), **dict(zip(self._variables, drive.inputs[0], strict=True))},
            input=signals, output=[self._value], fmi_type="ModelExchange", relative_tolerance=1e-7,
            output_interval=float(np.median(np.diff(t))), record_events=False,
        )  # fmt: skip
        return np.asarray(np.interp(t, result["time"], result[self._value]), dtype=np.float64)


def _free(slave: Any) -> None:
    try:
        slave.terminate()
        slave.freeInstance()
    except Exception:  # the process is leaving anyway
        return
