"""The numeric columns of a MATLAB, HDF5 or MDF file, read in a process of its own with the arguments FILE OUT.npz.

A damaged file can end these packages' compiled code, or unpack without bound: that ends this process, and no other.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from autotune.arrays import FloatArray

MATLAB, HDF5, MDF = (".mat",), (".h5", ".hdf5", ".hdf"), (".mf4", ".mdf")
#: What the npz holds beside the columns: form, names and units as JSON.
ABOUT = "about"
#: Address space of the process [bytes]; columns of one array at most.
_MOST_BYTES, _WIDEST = 3_000_000_000, 64
#: How HDF5 begins, behind a header of MATLAB's version 7.3 too.
_AS_HDF5 = b"\x89HDF"

#: Name, unit and values of a column.
_Column = tuple[str, str, FloatArray]


def array_columns(path: Path) -> tuple[str, list[_Column]]:
    """Return what kind of file it is, and its numeric columns.

    Parameters
    ----------
    path : Path
        Arrays or structures, datasets, or channels; samples of channels with rates of their own stand at their own
        times, NaN between them.

    Returns
    -------
    form : str
        For a person.
    columns : list of (str, str, (N,) array)
        Names, units and values.
    """
    kind = path.suffix.lower()
    with path.open("rb") as file:
        is_hdf5 = _AS_HDF5 in file.read(1024)
    if kind in MDF:
        return "MDF", list(_of_mdf(path))
    if kind in HDF5 or is_hdf5:
        return ("MATLAB 7.3" if kind in MATLAB else "HDF5"), list(_of_hdf5(path))
    return "MATLAB", list(_of_matlab(path))


def _vectors(name: str, unit: str, values: Any) -> Iterator[_Column]:
    """Yield a vector as one column, a matrix as one per column: its longer side are the rows."""
    array = np.atleast_2d(np.squeeze(np.asarray(values)))
    if array.dtype.kind not in "iufb" or array.ndim > 2 or min(array.shape) > _WIDEST or array.size < 2:
        return
    array = array if array.shape[0] <= array.shape[1] else array.T
    for k, column in enumerate(array):
        called = name if array.shape[0] == 1 else f"{name}_{k + 1}"
        yield called, unit, np.ascontiguousarray(column, dtype=np.float64)


def _of_matlab(path: Path) -> Iterator[_Column]:
    from scipy.io import loadmat

    for name, value in loadmat(path, squeeze_me=True, struct_as_record=False).items():
        if not name.startswith("__"):
            yield from _fields(name, value)


def _fields(name: str, value: Any, depth: int = 3) -> Iterator[_Column]:
    """Yield the arrays of a variable, those of structures under their fields, Simulink's under their labels."""
    names = getattr(value, "_fieldnames", None)
    if names is not None and depth:
        label = str(getattr(value, "label", "") or "")
        for field in names:
            called = label if label and field == "values" else f"{name}.{field}"
            yield from _fields(called, getattr(value, field), depth - 1)
    elif isinstance(value, np.ndarray) and value.dtype == object and depth:
        for k, one in enumerate(value.ravel()[:_WIDEST]):
            yield from _fields(f"{name}_{k + 1}", one, depth - 1)
    else:
        yield from _vectors(name, "", value)


def _of_hdf5(path: Path) -> Iterator[_Column]:
    import h5py

    found: list[_Column] = []

    def take(name: str, one: Any) -> None:
        if isinstance(one, h5py.Dataset) and one.dtype.kind in "iufb" and not name.startswith("#refs#"):
            unit = one.attrs.get("unit", one.attrs.get("units", ""))
            unit = unit.decode(errors="replace") if isinstance(unit, bytes) else str(unit)
            found.extend(_vectors(name.replace("/", "."), unit, one[()]))

    with h5py.File(path, "r") as file:
        file.visititems(take)
    yield from found


def _of_mdf(path: Path) -> Iterator[_Column]:
    import asammdf

    with asammdf.MDF(path) as file:
        channels = [one for one in file.iter_channels() if one.samples.ndim == 1 and one.samples.dtype.kind in "iufb"]
    t = np.unique(np.concatenate([np.zeros(0), *(one.timestamps for one in channels)]))
    yield "time", "s", t
    for one in channels:
        values = np.full(t.size, np.nan)
        values[np.searchsorted(t, one.timestamps)] = one.samples
        yield one.name, str(one.unit or ""), values


def _main() -> None:
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MOST_BYTES, _MOST_BYTES))
    form, columns = array_columns(Path(sys.argv[1]))
    about = json.dumps({"form": form, "names": [c[0] for c in columns], "units": [c[1] for c in columns]})
    # numbers and not names are the keys: those of a file may be anything
    arrays: dict[str, Any] = {str(k): values for k, (_, _, values) in enumerate(columns)}
    np.savez(sys.argv[2], **arrays | {ABOUT: np.array(about)})


if __name__ == "__main__":
    _main()
