"""Recordings from what a person has: a file, a DataFrame, a mapping of arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from autotune.arguments import check_arguments
from autotune.arrays import FloatArray
from autotune.errors import InputError
from autotune.recording import Recording, usable

#: A path, a pandas DataFrame, a mapping of arrays, or a recording.
Source: TypeAlias = Any
#: files of models, points and controllers, which are no recordings
_OTHER_FILES = ("", ".toml", ".json", ".fmu")


@check_arguments
def read(source: Source, *, t: str = "", u: str = "", y: str = "", r: str = "", name: str = "") -> Recording:
    """Return a recording of the command u and the measurement y over the time t.

    Parameters
    ----------
    source : path, pandas.DataFrame, mapping of arrays, or Recording
        A file is read as engineers have it (any delimiter, workbooks, stamps); of several stretches the longest is
        returned. A DataFrame may have its time in the index, as seconds or as dates.
    t, u, y, r : str
        Names of the columns of time, command, measurement and set-point; where they are not given, they are found out
        in a file, and are ``t``, ``u``, ``y``, ``r`` elsewhere.
    name : str
        For messages and figures.

    Returns
    -------
    Recording
        Further columns are kept in ``extra``.

    Raises
    ------
    InputError
        No such file or column, time that does not increase.

    Examples
    --------
    >>> import numpy as np
    >>> import autotune as at
    >>> t = np.arange(100) / 10
    >>> recording = at.read({"t": t, "u": np.sign(np.sin(t)), "y": np.cos(t)})
    >>> len(recording), round(recording.sample_time_s, 6)
    (100, 0.1)
    """
    if isinstance(source, Recording):
        if t or u or y or r:
            raise InputError(
                "a recording's columns have their names", where="read", remedy="name those of a file or a table"
            )
        return replace(source, name=name) if name else source
    if isinstance(source, str | os.PathLike):
        from autotune.files import SignalNames, read_recordings

        return read_recordings(source, SignalNames(t=t, u=u, y=y, r=r)).longest
    columns = source if isinstance(source, Mapping) else _of_frame(source, t or "t")
    roles = {"t": t or "t", "u": u or "u", "y": y or "y"}
    missing = [column for column in roles.values() if column not in columns]
    if missing:
        raise InputError(
            f"no column {missing[0]!r}",
            where=name or "recording",
            remedy=f"it has {', '.join(map(str, columns))}; name the columns by t=, u= and y=",
        )
    used = set(roles.values())
    extra = {("r" if key == r else str(key)): _numbers(values, str(key)) for key, values in columns.items()
             if key not in used and _is_numeric(values)}  # fmt: skip
    own = {role: _numbers(columns[column], column) for role, column in roles.items()}
    return Recording(t=own["t"], u=own["u"], y=own["y"], extra=extra, name=name or "recording")


def _of_frame(frame: Any, t: str) -> Mapping[str, Any]:
    if not hasattr(frame, "columns"):
        raise InputError(
            f"a {type(frame).__name__} is no recording",
            where="read",
            remedy="give a path, a DataFrame, or a mapping with t, u and y",
        )
    columns = {column: frame[column].to_numpy() for column in frame.columns}
    if t not in columns:
        index = frame.index.to_numpy()
        if np.issubdtype(index.dtype, np.datetime64):
            index = (index - index[0]) / np.timedelta64(1, "s")
        columns[t] = index
    return columns


def _is_numeric(values: Any) -> bool:
    return np.asarray(values).dtype.kind in "fiub"


def _numbers(values: Any, column: str) -> FloatArray:
    array = np.asarray(values)
    if np.issubdtype(array.dtype, np.datetime64):
        array = (array - array[0]) / np.timedelta64(1, "s")
    try:
        return np.ascontiguousarray(array, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise InputError(f"column {column!r} does not hold numbers", where="read", remedy="convert it first") from None


def recordings(source: Source, **names: str) -> list[Recording]:
    """Return one or several recordings; a list or tuple is several.

    Parameters
    ----------
    source : table, arrays, file, Recording, or a list of these
        As :func:`autotune.read` takes them.
    **names : str
        Which column is t, u, y or r.

    Raises
    ------
    InputError
        The list is empty, or one of them is no recording.
    """
    several = source if isinstance(source, list | tuple) else [source]
    if not several:
        raise InputError("no recording", where="read", remedy="give at least one")
    return [read(one, **names) for one in several]


def as_recordings(source: Any) -> list[Recording] | None:
    """Return all stretches of a recording, a list of them, a DataFrame or a file of one; None where it is none."""
    if isinstance(source, Recording):
        return [source]
    if isinstance(source, list | tuple):
        return list(source) if source and all(isinstance(one, Recording) for one in source) else None
    if hasattr(source, "columns") and hasattr(source, "index"):
        return [read(source)]
    if isinstance(source, str | os.PathLike) and os.path.splitext(source)[1].lower() not in _OTHER_FILES:
        from autotune.files import read_recordings

        return [usable(one) for one in read_recordings(source).recordings]
    return None
