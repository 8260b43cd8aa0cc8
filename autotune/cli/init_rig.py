"""What ``autotune init`` asks of a rig that is there, and the configuration that follows from the answers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from autotune.cli.init_keys import Table, register
from autotune.cli.init_questions import Questions, limits, middle, number, number_within, pair
from autotune.errors import InputError

if TYPE_CHECKING:
    from drivers.kinds import Kind

_RANGE = "lowest and highest {} the rig may see"

#: samples of a sweep: some 15 to 40 a period, a few periods for each of five points, and the way there
SWEEP_SAMPLES = 1e4

#: what a kind may have to be told, in the order in which it is asked: its key, the question
_ASKED = {
    "host": "address of the device",
    "endpoint": "address of the OPC UA server, opc.tcp://HOST:4840",
    "device": "serial device (autotune ports lists them)",
    "recording": "recording of a run, NAME.csv, which a run with the same settings replays",
    "y_span": "y at count 0 and at the converter's full scale",
    "u_span": "u at duty 0 and at duty 1",
}
#: answers that follow a custom, to be looked at in the file
_CUSTOM = {f"{which}_file": f"certificates/{name}" for which, name in
           {"ca": "ca.pem", "cert": "host.pem", "key": "host.key", "server_cert": "server.pem"}.items()}  # fmt: skip


def ask_rig(questions: Questions, kind: Kind, given: Mapping[str, Any]) -> Table:
    """Return the table [rig] of a rig that is there: what the settings of its kind have keys for is asked.

    Parameters
    ----------
    questions : Questions
        Those of the command.
    kind : Kind
        How the rig is reached.
    given : mapping of str to object
        What flags say, None where they do not.
    """
    keys = kind.settings.model_fields
    rig: Table = {"kind": kind.name} | {key: name for key, name in _CUSTOM.items() if key in keys}
    for key, question in _ASKED.items():
        if key in keys:
            convert = pair if key.endswith("_span") else str
            rig[key] = questions.ask(f"--{key.replace('_', '-')}", given[key], question, convert)
    if "nodes" in keys:
        asked = "node of {}, its id or path of browse names, e.g. ns=2;s=Ball.{}"
        rig["nodes"] = {one: questions.ask(f"--{one}-node", given[f"{one}_node"], asked.format(one, one), str)
                        for one in ("y", "u")}  # fmt: skip
    if "signals" in keys:
        asked = "place of {} in the CPU, e.g. DB10.DBD{}"
        rig["signals"] = {one: questions.ask(f"--{one}-place", given[f"{one}_place"], asked.format(one, at), str)
                          for one, at in (("y", 0), ("u", 4))}  # fmt: skip
    if kind.has_registers:
        asked = "register of {}, TABLE:ADDRESS:TYPE, e.g. {}:0:int16"
        y = questions.ask("--y-register", given["y"], asked.format("y", "input"), register)
        u = questions.ask("--u-register", given["u"], asked.format("u", "holding"), register)
        rig["registers"] = {"y": y, "u": u}
    return rig


def ask_signals(questions: Questions, given: Mapping[str, Any]) -> Table:
    """Return units, control period, ranges and the operating point; what no flag says is asked.

    Parameters
    ----------
    questions : Questions
        Those of the command.
    given : mapping of str to object
        What flags say, None where they do not.
    """
    answers: Table = {
        "u_unit": questions.ask("--u-unit", given["u_unit"], "unit of the command u", str, ""),
        "y_unit": questions.ask("--y-unit", given["y_unit"], "unit of the measurement y", str, ""),
        "sample_time_s": questions.ask("--sample-time", given["sample_time_s"], "control period [s], e.g. 0.1", number),
        "u_range": questions.ask("--u-range", given["u_range"], f"{_RANGE.format('command u')}, e.g. 0 100", limits),
    }
    of_u = number_within(answers["u_range"])
    answers["u_safe"] = questions.ask("--u-safe", given["u_safe"], "command at which the rig may be left alone", of_u)
    answers["y_range"] = questions.ask("--y-range", given["y_range"], _RANGE.format("measurement y"), limits)
    of_y, centre = number_within(answers["y_range"]), middle(answers["y_range"])
    # y is chosen, its middle suggested; what command holds it there is known to the person alone
    answers["y"] = questions.ask("--y", given["y"], "y of the operating point", of_y, suggested=centre)
    answers["u"] = questions.ask("--u", given["u"], "command that holds it there, about", of_u)
    return answers


def config_of(rig: Table, answers: Table) -> Table:
    """Return the configuration of a real rig: what was answered, and cautious values that follow from it.

    Parameters
    ----------
    rig : dict
        The table [rig].
    answers : dict
        Of :func:`ask_signals`.
    """
    u_min, u_max = answers["u_range"]
    y_min, y_max = answers["y_range"]
    room = min(answers["y"] - y_min, y_max - answers["y"])
    if not room > 0.0:
        raise InputError(f"y = {answers['y']:g} is not within {y_min:g}..{y_max:g}", where="operating_point.y")
    # a quarter of the room leaves the rest to overshoot; rounded to what a person would have written
    swing = round_to_two(0.25 * room)
    # no further than half of the way to the end of the command's range, where a relay would have no room; a command at
    # the very end is refused as such
    room_u = min(answers["u"] - u_min, u_max - answers["u"]) or u_max - u_min
    uncertainty = min(0.05 * (u_max - u_min), 0.5 * room_u)
    T_s = answers["sample_time_s"]
    budget_s = max(60.0, round_to_two(SWEEP_SAMPLES * T_s))
    return {
        "rig": rig,
        "signals": {name: answers[name] for name in ("sample_time_s", "u_unit", "y_unit")},
        "limits": {"u_min": u_min, "u_max": u_max, "u_safe": answers["u_safe"],
                   "y_min": y_min, "y_max": y_max, "swing": swing, "time_s": 4.0 * budget_s},
        "operating_point": {"y": answers["y"], "u_guess": answers["u"],
                            "u_uncertainty": round_to_two(uncertainty), "approach": "hold"},
        "experiment": {"points": 5, "budget_s": budget_s},
    }  # fmt: skip


def round_to_two(value: float) -> float:
    """Return a value with two digits, as a person would have written it."""
    return float(f"{value:.2g}")
