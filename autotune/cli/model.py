"""Commands on model files: from other tools, to other tools, checked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import typer

from autotune.cli import app
from autotune.cli.common import OVERWRITE
from autotune.cli.plain_help import PlainGroup
from autotune.outputs import Output

if TYPE_CHECKING:
    from autotune.equations.model import EquationModel
    from autotune.models import Model

model_app = typer.Typer(cls=PlainGroup, help="Model files from other tools and for other tools.", no_args_is_help=True)
app.add_typer(model_app, name="model")

Form = Literal["toml", "text", "latex", "modelica", "python", "fmu"]
OUT = Annotated[Path, typer.Option(help="model file to write", metavar="M.toml")]


def _write(model: Model | EquationModel, place: Output) -> None:
    from autotune.equations import write_equations
    from autotune.model_tables import write_model
    from autotune.models import Model

    if isinstance(model, Model):
        place.by(lambda part: write_model(model, part))
    else:
        place.by(lambda part: write_equations(model, part))
    typer.echo(f"wrote {place.path}")


@model_app.command("from-control")
def from_control(
    system: Annotated[str, typer.Argument(help="variable of a Python file, which is run", metavar="FILE.py:name")],
    out: OUT,
    overwrite: OVERWRITE = False,
) -> None:
    """Write the model file of a python-control system."""
    from autotune.equations.imports import from_python_file

    place = Output(out, inputs=(Path(system.rpartition(":")[0] or system),), overwrite=overwrite)
    _write(from_python_file(system), place)


@model_app.command("from-matlab", context_settings={"ignore_unknown_options": True})
def from_matlab(
    num: Annotated[str, typer.Argument(help='numerator, descending powers of s, "[2 1]"')],
    den: Annotated[str, typer.Argument(help='denominator, "[1 3 0]"')],
    out: OUT,
    delay: Annotated[float, typer.Option(min=0.0, help="dead time [s]")] = 0.0,
    overwrite: OVERWRITE = False,
) -> None:
    """Write the model file of a transfer function as MATLAB prints it."""
    from autotune.equations.imports import from_matlab as made

    _write(made(num, den, delay, name=out.stem), Output(out, overwrite=overwrite))


@model_app.command("from-text", context_settings={"ignore_unknown_options": True})
def from_text(
    text: Annotated[str, typer.Argument(help='transfer function as written: "-65.5/(s(0.36s+1)) e^-0.1s"')],
    out: OUT,
    overwrite: OVERWRITE = False,
) -> None:
    """Write the model file of a transfer function as people write it: rational in s, zpk, gain and time constants."""
    from autotune.equations.imports import from_coefficients
    from autotune.equations.transfer_text import parse_transfer_function

    tf = parse_transfer_function(text)
    _write(from_coefficients(tf.num, tf.den, tf.delay_s, name=out.stem), Output(out, overwrite=overwrite))


@model_app.command("from-fmu")
def from_fmu(
    fmu: Annotated[Path, typer.Argument(help="FMU, FMI 2.0 or 3.0", metavar="RIG.fmu")],
    out: OUT,
    overwrite: OVERWRITE = False,
) -> None:
    """Write the model file of an FMU: its inputs, its first output, its parameters; edit it to taste."""
    import os

    import tomli_w

    from autotune.equations.fmu import template

    place = Output(out, inputs=(fmu,), overwrite=overwrite)
    content = template(fmu)
    content["fmu"] = os.path.relpath(fmu.resolve(), out.resolve().parent)
    place.by(lambda part: Path(part).write_bytes(tomli_w.dumps(content).encode()))
    typer.echo(f"wrote {out}")


@model_app.command("check")
def check(model: Annotated[Path, typer.Argument(help="model file", metavar="M.toml")]) -> None:
    """Read a model file, check names, loops and units, and say what it holds."""
    from autotune.equations import EquationModel, compile_model
    from autotune.equations.black_box import BlackBox
    from autotune.equations.effects import apply
    from autotune.model_file import read_any as read_any_model

    found = read_any_model(model)
    if isinstance(found, BlackBox):
        names = ", ".join(p.name for p in found.parameters) or "none"
        typer.echo(f"{found.name}: an FMU, inputs {', '.join(found.columns)}, parameters {names}")
        return
    if not isinstance(found, EquationModel):
        typer.echo(f"{found.name}: a chain of {len(found.blocks)} block(s)")
        return
    compile_model(found, apply(found).extensions)
    retuned = [p.name for p in found.parameters if p.spread > 0.0]
    typer.echo(
        f"{found.name}: states {', '.join(found.state_names)}; inputs {', '.join(found.columns)}; "
        f"to be retuned {', '.join(retuned) or 'nothing'}"
    )


@model_app.command("export")
def export(
    model: Annotated[Path, typer.Argument(help="model file, nominal or extended", metavar="M.toml")],
    form: Annotated[Form, typer.Option(help=f"one of {', '.join(get_args(Form))}")],
    out: Annotated[Path, typer.Option(help="file to write", metavar="FILE")],
    overwrite: OVERWRITE = False,
) -> None:
    """Write a model for another tool, its effects written out as equations."""
    from autotune.equations.exports import as_modelica, as_python, as_text
    from autotune.equations.flatten import flatten
    from autotune.equations.fmu_export import as_fmu
    from autotune.equations.typeset import as_latex

    place = Output(out, inputs=(model,), overwrite=overwrite)
    if form == "fmu" and (chain := _chain_with_effects(model)) is not None:
        _export_chain(chain, place)
        return
    equations = _equations(model)
    if form == "toml":
        _write(flatten(equations), place)
        return
    if form == "fmu":
        content, library = as_fmu(equations)
        _write_fmu(content, library, place)
        return
    text = {"text": as_text, "latex": as_latex, "modelica": as_modelica, "python": as_python}[form](equations)
    place.text(text)
    typer.echo(f"wrote {out}")


def _write_fmu(content: bytes, library: str, place: Output) -> None:
    place.by(lambda part: Path(part).write_bytes(content))
    built = f"a library for {library}" if library else "no library, as there is no C compiler"
    typer.echo(f"wrote {place.path}: FMI 3.0 for co-simulation, its C source and {built}")


def _chain_with_effects(path: Path) -> Model | None:
    from autotune.model_file import read_any as read_any_model
    from autotune.models import Model

    found = read_any_model(path)
    return found if isinstance(found, Model) and found.effects else None


def _export_chain(chain: Model, place: Output) -> None:
    """Write a chain with its effects as an FMU, and say which of them no simulation has."""
    from autotune.diagnosis.simulation.chain_fmu import chain_as_fmu, left_out_of_fmu

    _write_fmu(*chain_as_fmu(chain), place)
    if missing := left_out_of_fmu(chain):
        typer.echo(f"left out, as in every simulation: {', '.join(missing)}")


@model_app.command("linearise", context_settings={"ignore_unknown_options": True})
def linearise(
    model: Annotated[Path, typer.Argument(help="model file of equations", metavar="M.toml")],
    at: Annotated[str, typer.Option(help='inputs of the operating point: "u=0.5 supply=12"')],
    out: OUT,
    y: Annotated[float, typer.Option(help="reading there, where the plant integrates")] = float("nan"),
    overwrite: OVERWRITE = False,
) -> None:
    """Write the chain that equations are near an operating point: what design and margins take."""
    import numpy as np

    from autotune.equations.linearise import as_chain
    from autotune.equations.linearise import linearise as linear
    from autotune.errors import InputError

    place = Output(out, inputs=(model,), overwrite=overwrite)
    equations = _equations(model)
    try:
        given = {k: float(v) for k, v in (part.split("=") for part in at.replace(",", " ").split())}
    except ValueError:
        raise InputError(f"{at!r}", where="--at", remedy='write "u=0.5 supply=12"') from None
    unknown = sorted(set(given) - set(equations.columns))
    if unknown:
        raise InputError(f"no input {unknown[0]!r}", where="--at", remedy=f"it has {', '.join(equations.columns)}")
    point = np.array([given.get(column, 0.0) for column in equations.columns])
    _write(as_chain(equations, linear(equations, point, y)), place)


def _equations(path: Path) -> EquationModel:
    """Return the equations of a model file; a chain without effects becomes some."""
    from autotune.equations import EquationModel
    from autotune.equations.chain import from_chain
    from autotune.errors import InputError
    from autotune.model_file import read_any as read_any_model
    from autotune.models import Model

    found = read_any_model(path)
    if isinstance(found, EquationModel):
        return found
    if isinstance(found, Model) and not found.effects:
        return from_chain(found)
    raise InputError("its equations cannot be written out", where=str(path),
                     remedy="give equations, or a chain without effects")  # fmt: skip
