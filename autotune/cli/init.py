"""Commands on the configuration file: a commented one from few questions or from flags, and its schema."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer
from rich.console import Console

from autotune.cli import app
from autotune.cli.common import OVERWRITE
from autotune.cli.init_keys import REGISTER, Table, add_registers, set_keys
from autotune.cli.init_model import EXAMPLE, ModelOfRig, model_of_rig
from autotune.cli.init_questions import Questions, number_of_option, one_of
from autotune.cli.init_rig import ask_rig, ask_signals, config_of, round_to_two
from autotune.cli.init_text import text_of
from autotune.errors import InputError
from autotune.outputs import Output

if TYPE_CHECKING:
    from drivers.kinds import Kind

Plant = Literal["ball", "servo", "two_tank", "thermal"]

#: half-width of the noise of a twin's sensor, over the range of y, and steps of its converter over that range
NOISE, CONVERTER = 1e-3, 4096

#: what is known of the simulated plants
PLANTS: Mapping[Plant, Table] = {
    "ball": {
        "rig": {"seed": 1, "noise": 0.35},
        "signals": {"sample_time_s": 0.01, "u_unit": "V", "y_unit": "V", "u_step": 10.0 / 4096.0},
        "limits": {"u_min": 0.0, "u_max": 10.0, "u_safe": 0.0, "u_rate": 200.0, "y_min": 1.0, "y_max": 9.0,
                   "swing": 3.0, "time_s": 180.0},
        "operating_point": {"y": 5.0, "u_guess": 5.0, "u_uncertainty": 0.5, "approach": "ramp"},
        "experiment": {"gain_sd": 0.0044, "budget_s": 58.0},
        "controller": {"K": -0.01, "Ti_s": 6.0},
    },
    "servo": {
        "signals": {"sample_time_s": 0.002, "u_unit": "V", "y_unit": "rad"},
        "limits": {"u_min": -10.0, "u_max": 10.0, "u_safe": 0.0, "y_min": -3.0, "y_max": 3.0, "swing": 0.5,
                   "time_s": 120.0},
        "operating_point": {"y": 0.0, "u_guess": 0.0, "u_uncertainty": 0.3, "approach": "hold"},
        "experiment": {"budget_s": 30.0},
        "controller": {"K": 1.0, "Ti_s": 1.0},
    },
    "two_tank": {
        "rig": {"start": "level"},
        "signals": {"sample_time_s": 1.0, "u_unit": "V", "y_unit": "cm"},
        "limits": {"u_min": 0.0, "u_max": 10.0, "u_safe": 0.0, "y_min": 5.0, "y_max": 15.0, "swing": 2.0,
                   "time_s": 20000.0},
        "operating_point": {"y": 10.0, "u_guess": 3.0, "u_uncertainty": 0.4, "approach": "hold"},
        "experiment": {"budget_s": 7200.0},
        "controller": {"K": 0.5, "Ti_s": 200.0},
    },
    "thermal": {
        "rig": {"start": "warm"},
        "signals": {"sample_time_s": 1.0, "u_unit": "%", "y_unit": "degC"},
        "limits": {"u_min": 0.0, "u_max": 100.0, "u_safe": 0.0, "y_min": 30.0, "y_max": 70.0, "swing": 15.0,
                   "time_s": 20000.0},
        "operating_point": {"y": 50.0, "u_guess": 18.0, "u_uncertainty": 3.0, "approach": "hold"},
        "experiment": {"budget_s": 7200.0},
        "controller": {"K": 0.5, "Ti_s": 200.0},
    },
}  # fmt: skip


def _take_number(help: str) -> Any:
    """Return an option whose number may have a decimal comma."""
    return typer.Option(parser=number_of_option, metavar="NUMBER", help=help)


_Pair: TypeAlias = tuple[float, float] | None
_REGISTERS = Annotated[
    list[str] | None,
    typer.Option(
        "--register",
        metavar=f"NAME={REGISTER}",
        help="any further register of the map, e.g. heartbeat=holding:2:uint16, enable=holding:20,bit=3,"
        " gains.PB_percent=holding:30,scale=0.1; may be given more than once",
    ),
]
_MODEL = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|H(s)",
        help=f"in place of --plant: a model file, or a transfer function as you write it, {EXAMPLE} or zpk([-1];"
        " [-2, -3]; 4) or K=2 T=0.3,0.1 L=0.05, which becomes a model file beside the configuration",
    ),
]
_KEYS = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="any other key by its path, e.g. rig.port=1502; may be given more than once"
    ),
]


@app.command()
def init(
    config: Annotated[Path, typer.Argument(metavar="CONFIG.toml", help="file to write; never overwritten")],
    kind: Annotated[
        str | None, typer.Option(help="how the rig is reached: simulated, modbus_tcp, serial; an unknown one lists all")
    ] = None,
    plant: Annotated[
        Plant | None, typer.Option(help="which simulated plant; of a real rig: the plant of its twin for --dry-run")
    ] = None,
    host: Annotated[str | None, typer.Option(help="address of a Modbus TCP or TLS device, or of a Siemens CPU")] = None,
    device: Annotated[str | None, typer.Option(help="serial device, see autotune ports")] = None,
    endpoint: Annotated[str | None, typer.Option(help="address of an OPC UA server, opc.tcp://HOST:4840")] = None,
    y_node: Annotated[str | None, typer.Option(metavar="NODE", help="node of y on it, e.g. ns=2;s=Ball.y")] = None,
    u_node: Annotated[str | None, typer.Option(metavar="NODE", help="node of u on it")] = None,
    y_place: Annotated[
        str | None, typer.Option(metavar="PLACE", help="place of y in a Siemens CPU, e.g. DB10.DBD0")
    ] = None,
    u_place: Annotated[str | None, typer.Option(metavar="PLACE", help="place of u in it")] = None,
    recording: Annotated[str | None, typer.Option(help="recording that is replayed as a rig")] = None,
    y_register: Annotated[
        str | None, typer.Option(metavar=REGISTER, help="Modbus register of y, e.g. input:0:int16,scale=0.01")
    ] = None,
    u_register: Annotated[
        str | None, typer.Option(metavar=REGISTER, help="Modbus register of u, e.g. holding:0:float32")
    ] = None,
    registers: _REGISTERS = None,
    model: _MODEL = None,
    keys: _KEYS = None,
    y_span: Annotated[_Pair, typer.Option(help="y at count 0 and at full scale of a microcontroller [y unit]")] = None,
    u_span: Annotated[_Pair, typer.Option(help="u at count 0 and at full scale of a microcontroller [u unit]")] = None,
    sample_time: Annotated[float | None, _take_number("control period [s]")] = None,
    u_unit: Annotated[str | None, typer.Option(help="unit of the command")] = None,
    y_unit: Annotated[str | None, typer.Option(help="unit of the measurement")] = None,
    u_range: Annotated[_Pair, typer.Option(help="lowest and highest command [u unit]")] = None,
    u_safe: Annotated[float | None, _take_number("command the rig may be left with [u unit]")] = None,
    y_range: Annotated[_Pair, typer.Option(help="lowest and highest y of the experiment [y unit]")] = None,
    y: Annotated[float | None, _take_number("y of the operating point [y unit]")] = None,
    u: Annotated[float | None, _take_number("command that holds y there, about [u unit]")] = None,
) -> None:
    """Write a commented configuration; asks at a terminal for what no flag says."""
    if config.exists():
        raise InputError("exists already", where=str(config), remedy="choose another name; nothing is overwritten")
    told: Table = {"u_unit": u_unit, "y_unit": y_unit, "sample_time_s": sample_time, "u_range": u_range}
    told |= {"u_safe": u_safe, "y_range": y_range, "y": y, "u": u}
    given: Table = {"host": host, "device": device, "recording": recording, "y_span": y_span, "u_span": u_span}
    given |= {"endpoint": endpoint, "y_node": y_node, "u_node": u_node, "y_place": y_place, "u_place": u_place}
    given |= {"y": y_register, "u": u_register, "registers": registers or ()}
    _write_config(config, kind, plant, model, given, told, keys or ())


def _write_config(
    config: Path, kind: str | None, plant: Plant | None, model: str | None, given: Table, told: Table,
    keys: Sequence[str],
) -> None:  # fmt: skip
    """Ask for what was not told of the rig and its signals, and write the configuration."""
    from autotune.config import Config, validate
    from autotune.config.rig import SimulatedRigSettings
    from drivers.kinds import KINDS

    questions = Questions()
    kinds = {one.name: one for one in KINDS}
    question = f"how is the rig reached ({', '.join(kinds)})"
    chosen: Kind = questions.ask(
        "--kind", kind, question, lambda name: kinds[one_of(_underscored(name), kinds, "--kind")], suggested="simulated"
    )
    questions.require()  # the others hang on it
    simulated = chosen.settings is SimulatedRigSettings
    twin: Plant | ModelOfRig | None = plant if model is None else model_of_rig(model)
    if simulated:
        asked = f"which plant: {', '.join(PLANTS)}, a model file, or a transfer function such as {EXAMPLE}"
        twin = questions.ask("--plant", twin, asked, _plant_or_model, suggested="ball")
        questions.require()
    answers: Table = {}
    if simulated and isinstance(twin, str):
        content = _simulated_config(twin, told)
    else:
        reached = ask_rig(questions, chosen, given)
        if given["registers"] and not chosen.has_registers:
            raise InputError(f'kind = "{chosen.name}" has no registers', where="--register", remedy="leave it out")
        add_registers(reached.get("registers", {}), given["registers"])
        if "twin" in chosen.settings.model_fields:
            asked = f"a twin for --dry-run: a transfer function such as {EXAMPLE}, a model file, or Enter for none"
            twin = questions.ask("--model", twin, asked, _plant_or_model, "") or None
        if isinstance(twin, ModelOfRig):
            twin.place(config)  # refused before more is asked in vain
        answers = ask_signals(questions, told)
        questions.require()
        played = _settings_of_twin(twin, config, answers)
        content = config_of(reached | (played if simulated else {"twin": played} if played else {}), answers)
    content = {"name": config.stem, **content}
    set_keys(content, keys)
    validate(Config, content, str(config))
    place = Output(config)
    written = twin.write(config, answers) if isinstance(twin, ModelOfRig) else None
    place.text(text_of(content, config))
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"wrote {config}" + (f" and {written}" if written else ""), markup=False)
    if simulated or chosen.name == "replay":
        console.print(f"next: autotune run {config} --out runs/{config.stem}", markup=False)
    else:
        console.print(f"next: read it through, then autotune doctor {config}, autotune probe {config}", markup=False)


def _underscored(name: str) -> str:
    return name.replace("-", "_")  # modbus-tcp, as people write it


def _plant_or_model(answer: str) -> str | ModelOfRig:
    """Return the name of a simulated plant, a model, or nothing for no answer."""
    if not answer or answer in PLANTS:
        return answer
    try:
        return model_of_rig(answer)
    except InputError as error:
        raise InputError(
            f"{answer!r} is none of {', '.join(PLANTS)}, no model file, and no transfer function: {error.what}",
            where="--plant",
            remedy=error.remedy,
        ) from None


def _settings_of_twin(twin: Plant | ModelOfRig | None, config: Path, answers: Table) -> Table:
    """Return what a simulated rig, or the twin of a real one, is to play: of a model with the usual sensor."""
    if isinstance(twin, ModelOfRig):
        span = abs(answers["y_range"][1] - answers["y_range"][0])
        return {
            "model": twin.path(config),
            "noise": round_to_two(NOISE * span),
            "resolution": round_to_two(span / CONVERTER),
        }
    return {} if twin is None else {"plant": twin, **PLANTS[twin].get("rig", {})}


def _simulated_config(plant: Plant, told: Table) -> Table:
    """Return the configuration of a plant that is known, with what was told in place of what is known of it."""
    known = {name: dict(table) for name, table in PLANTS[plant].items()}
    for name in ("u_unit", "y_unit", "sample_time_s", "u_safe", "u_range", "y_range", "y", "u"):
        match name, told[name]:
            case _, None:
                continue
            case "u_range" | "y_range", (low, high):
                known["limits"] |= {f"{name[0]}_min": low, f"{name[0]}_max": high}
            case "u_safe", value:
                known["limits"][name] = value
            case "y" | "u", value:
                known["operating_point"]["y" if name == "y" else "u_guess"] = value
            case _, value:
                known["signals"][name] = value
    return {"rig": {"kind": "simulated", "plant": plant, **known.pop("rig", {})}, **known}


@app.command()
def schema(
    out: Annotated[Path, typer.Option(help="file to write the JSON Schema of the config to")],
    overwrite: OVERWRITE = False,
) -> None:
    """Write the JSON Schema of the configuration, so that editors complete its keys."""
    from autotune.config import json_schema

    place = Output(out, overwrite=overwrite)
    place.json(json_schema())
    typer.echo(f"wrote {out}")
