"""The folder of a run: names of its files, the configuration it began with, and what an interrupted one left there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from autotune.config import Config, load_config
from autotune.errors import InputError
from autotune.points import FrequencyPoint, read_points
from autotune.text_files import read_json
from autotune.whole_files import write_whole

if TYPE_CHECKING:  # a recording is tuned without what runs a rig
    from autotune.experiment.cycles import Earlier

RECORDING, VERIFICATION, RESULT, JOURNAL = "recording.csv", "verification.csv", "result.json", "journal.jsonl"
PROGRESS, CONFIG, REPORT, CONTROLLER = "progress.jsonl", "config.toml", "report.html", "controller.toml"

#: what a new run writes, its configuration apart, which may be the one that it was given
FILES_OF_A_RUN = (RECORDING, VERIFICATION, RESULT, JOURNAL, PROGRESS, REPORT, CONTROLLER)

#: signals that no point depends on: a scale that turned out to be too coarse for the gains may be changed
_OF_GAINS = tuple(
    f"rig.{where}.{name}"
    for where in ("registers", "nodes", "signals")
    for name in ("K", "Ti", "Td", "Tf", "gains", "unlock")
)
#: sections of the configuration that the measured points depend on
EXPERIMENT_SECTIONS = ("rig", "signals", "limits", "operating_point", "experiment")


def numbered_paths(path: Path) -> Iterator[Path]:
    """Yield NAME.csv, NAME-2.csv, NAME-3.csv, ..."""
    yield path
    for number in count(2):
        yield path.with_stem(f"{path.stem}-{number}")


def next_free(path: Path, *suffixes: str) -> Path:
    """Return the first of the numbered names that no file has, nor one beside it with one of the suffixes.

    Parameters
    ----------
    path : Path
        The first name.
    *suffixes : str
        Endings of the files beside it.
    """
    return next(
        each
        for each in numbered_paths(path)
        if not any(one.exists() for one in (each, *map(each.with_suffix, suffixes)))
    )


def recordings(folder: Path, name: str = RECORDING) -> tuple[Path, ...]:
    """Return the recordings of this name in the folder, by default the sweep's, the oldest first.

    Parameters
    ----------
    folder : Path
        Of a run.
    name : str
        Of the first of them.
    """
    return tuple(takewhile(Path.exists, numbered_paths(folder / name)))


def store_config(config: Config, folder: Path) -> None:
    """Keep the configuration that a run begins with beside its recordings.

    One that says the same is left as it is, with the comments of whoever wrote it; one that differs where a resumed
    run may differ is kept under the next free name.

    Parameters
    ----------
    config : Config
        As it was checked.
    folder : Path
        Of the run.
    """
    place = folder / CONFIG
    if place.is_file():
        if _stores(config, place):
            return
        place.rename(next_free(place))
    write_whole(place, tomli_w.dumps(config.model_dump(mode="json", exclude_none=True)))


def may_store(config: Config, folder: Path) -> None:
    """Refuse a folder for a new run that holds a configuration other than this one.

    Parameters
    ----------
    config : Config
        As it was checked.
    folder : Path
        Of the run.

    Raises
    ------
    InputError
        It does; nothing is overwritten.
    """
    if (folder / CONFIG).exists() and not _stores(config, folder / CONFIG):
        raise InputError(f"holds a {CONFIG} that says something else", where=str(folder), remedy="choose another --out")


def _stores(config: Config, place: Path) -> bool:
    try:
        return load_config(place) == config
    except InputError:
        return False


def read_stored_config(folder: Path) -> Config:
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


def _read_json(path: Path) -> dict[str, Any]:
    content = read_json(path)
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
    from autotune.experiment.cycles import read_earlier

    different = differences(read_stored_config(folder), config)
    if different:
        raise InputError(
            f"the configuration is not the one that the run began with: {'; '.join(different)}",
            where=str(folder),
            remedy=f"go on with {folder / CONFIG}, or begin a new run",
        )
    if _is_complete(folder / RESULT):
        raise InputError("the run is complete", where=str(folder), remedy="autotune verify tries its controller again")
    return read_earlier(recordings(folder), config.signals.sample_time_s)


def _is_complete(result: Path) -> bool:
    """Return whether a run says that it came to its end; a killed one leaves no result, a full disk perhaps half."""
    try:
        experiment = _read_json(result).get("experiment")
    except InputError:
        return False
    return isinstance(experiment, dict) and experiment.get("reason") == "completed"


def differences(stored: Config, given: Config) -> tuple[str, ...]:
    """Return the keys that the measured points depend on and that differ, each with both values.

    Parameters
    ----------
    stored, given : Config
        That of the run so far, and that of the one that goes on.
    """
    was, now = (_flat(config.model_dump(mode="json", include=set(EXPERIMENT_SECTIONS))) for config in (stored, given))
    keys = [*was, *(key for key in now if key not in was)]
    return tuple(
        f"{key} = {now.get(key)!r}, was {was.get(key)!r}"
        for key in keys
        if now.get(key) != was.get(key) and not key.startswith(_OF_GAINS)
    )


def _flat(table: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        here = f"{path}.{key}" if path else key
        flat |= _flat(value, here) if isinstance(value, Mapping) else {here: value}
    return flat
