"""The folder of a run: names of its files, the configuration it began with, and what an interrupted one left there."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import tomli_w

from autotune.config import Config, load_config
from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.experiment.cycles import Earlier, read_earlier
from autotune.points import FrequencyPoint, read_points

RECORDING, VERIFICATION, RESULT, JOURNAL = "recording.csv", "verification.csv", "result.json", "journal.jsonl"
PROGRESS, CONFIG = "progress.jsonl", "config.toml"

#: sections of the configuration that the measured points depend on
EXPERIMENT_SECTIONS = ("rig", "signals", "limits", "operating_point", "experiment")


def numbered(path: Path) -> Iterator[Path]:
    """Yield NAME.csv, NAME-2.csv, NAME-3.csv, ..."""
    yield path
    for number in count(2):
        yield path.with_stem(f"{path.stem}-{number}")


def next_free(path: Path) -> Path:
    """Return the first of the numbered names that no file has."""
    return next(each for each in numbered(path) if not each.exists())


def recordings(folder: Path, name: str = RECORDING) -> tuple[Path, ...]:
    """Return the recordings of this name in the folder, by default the sweep's, the oldest first."""
    return tuple(takewhile(Path.exists, numbered(folder / name)))


def store_config(config: Config, folder: Path) -> None:
    """Keep the configuration that a run begins with beside its recordings."""
    content = config.model_dump(mode="json", exclude_none=True)
    (folder / CONFIG).write_text(tomli_w.dumps(content), encoding="utf-8")


def stored_config(folder: Path) -> Config:
    """Return the configuration that the run in the folder began with.

    Raises
    ------
    InputError
        There is none.
    """
    if not (folder / CONFIG).is_file():
        raise InputError(f"no {CONFIG}", where=str(folder), remedy="give the folder of a run that autotune run began")
    return load_config(folder / CONFIG)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What a finished run knows of its rig: points, noise of y [y unit], command at the operating point [u unit]."""

    points: tuple[FrequencyPoint, ...]
    noise_sd: float | None = None
    u_rest: float | None = None


def read_measured(folder: Path) -> Measured:
    """Return what the run in the folder measured.

    Raises
    ------
    InputError
        No result, or one without points.
    """
    points = read_points(folder / RESULT)
    experiment = _read_json(folder / RESULT).get("experiment", {})
    if not points:
        raise InputError(
            "the run measured no points", where=str(folder / RESULT), remedy="autotune run CONFIG --resume"
        )
    return Measured(points=points, noise_sd=experiment.get("noise_sd"), u_rest=experiment.get("u_rest"))


def read_designed(path: Path) -> PIDController:
    """Return the controller of a ``design.json``, or of a run's ``result.json``.

    Raises
    ------
    InputError
        No such file, or no PI or PID in it.
    """
    content = _read_json(path)
    design = content.get("controller", content)
    try:
        gains = {key: float(design[key] or 0.0) for key in ("K", "Td_s", "Tf_s")}
        Ti_s = math.inf if design["Ti_s"] is None else float(design["Ti_s"])
    except (KeyError, TypeError, ValueError):
        raise InputError(
            "holds no K, Ti_s, Td_s, Tf_s",
            where=str(path),
            remedy="give a design.json or the folder of a completed run",
        ) from None
    return PIDController(**gains, Ti_s=Ti_s, setpoint_weight=float(design.get("setpoint_weight", 1.0)))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    except ValueError as error:
        raise InputError(f"not JSON: {error}", where=str(path)) from None
    if not isinstance(content, dict):
        raise InputError("not a result", where=str(path), remedy="give a file that autotune wrote")
    return content


def read_interrupted(folder: Path, config: Config) -> Earlier:
    """Return what an interrupted run left, its points computed again from its recordings.

    Parameters
    ----------
    folder : Path
        Of the run.
    config : Config
        What it is to be continued with.

    Raises
    ------
    InputError
        No run, one that was completed, or a configuration that measures something else; names every difference.
    """
    different = differences(stored_config(folder), config)
    if different:
        raise InputError(
            f"the configuration is not the one that the run began with: {'; '.join(different)}",
            where=str(folder),
            remedy=f"go on with {folder / CONFIG}, or begin a new run",
        )
    result = _read_json(folder / RESULT) if (folder / RESULT).exists() else {}  # a killed run leaves none
    if result.get("experiment", {}).get("reason") == "completed":
        raise InputError("the run is complete", where=str(folder), remedy="autotune verify tries its controller again")
    return read_earlier(recordings(folder), config.signals.sample_time_s)


def differences(stored: Config, given: Config) -> tuple[str, ...]:
    """Return the keys that the measured points depend on and that differ, each with both values."""
    was, now = (_flat(config.model_dump(mode="json", include=set(EXPERIMENT_SECTIONS))) for config in (stored, given))
    keys = [*was, *(key for key in now if key not in was)]
    return tuple(f"{key} = {now.get(key)!r}, was {was.get(key)!r}" for key in keys if now.get(key) != was.get(key))


def _flat(table: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        here = f"{path}.{key}" if path else key
        flat |= _flat(value, here) if isinstance(value, Mapping) else {here: value}
    return flat
