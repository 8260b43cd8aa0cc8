"""Files of arrays as tables: MATLAB (.mat), HDF5 (.h5, .hdf5) and MDF (.mf4, .mdf)."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import InputError, require_extra
from autotune.files.array_columns import ABOUT, HDF5, MATLAB, MDF
from autotune.files.cells import Cells
from autotune.files.table import Table, bare_and_unit, list_names

KINDS = (*MATLAB, *HDF5, *MDF)
#: Rows of each end of a column that are looked at; how long reading may take [s].
_LOOKED_AT, _PATIENCE_S = 300, 120.0


def measurement_table(path: Path) -> Table:
    """Open a file of arrays as a table: its columns of the length that most of them have.

    Parameters
    ----------
    path : Path
        Arrays or structures of MATLAB, datasets of HDF5, channels of MDF.

    Raises
    ------
    InputError
        It cannot be read, holds no two columns of one length, or a package is not installed.
    """
    if path.suffix.lower() in MDF:
        require_extra("measurement", "asammdf")
    if path.suffix.lower() in HDF5:
        require_extra("measurement", "h5py")
    form, found, units = _read_apart(path)
    lengths = Counter(values.size for values in found.values())
    rows, count = max(lengths.items(), key=lambda pair: (pair[1], pair[0]), default=(0, 0))
    if count < 2:
        raise InputError(
            f"no two columns of numbers have one length ({list_names(found) or 'it holds no arrays'})", where=str(path),
            remedy="save time, command and measurement as arrays of one length, or as CSV",
        )  # fmt: skip
    kept = {name: values for name, values in found.items() if values.size == rows}
    # the last part of a name says enough where it is one column's
    lasts = Counter(name.rpartition(".")[2] for name in kept)
    called = {last if lasts[last := name.rpartition(".")[2]] == 1 else name: name for name in kept}
    own = {name: units[full] or bare_and_unit(name)[1] for name, full in called.items()}
    ends = np.unique(np.r_[: min(_LOOKED_AT, rows), max(0, rows - _LOOKED_AT) : rows])

    def load(wanted: Sequence[str]) -> dict[str, Cells]:
        return {name: kept[called[name]] for name in wanted}

    return Table(
        path=str(path), names=tuple(called), units={name: unit for name, unit in own.items() if unit}, labels={},
        form=form, decimal=".", in_seconds=frozenset(["time"] if form == "MDF" else []),
        sample={name: kept[full][ends] for name, full in called.items()}, load=load,
    )  # fmt: skip


def _read_apart(path: Path) -> tuple[str, dict[str, FloatArray], dict[str, str]]:
    """Return form, columns and units of a file that another process has read."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "columns.npz"
        call = [sys.executable, "-m", "autotune.files.array_columns", str(path.resolve()), str(out)]
        try:
            done = subprocess.run(call, capture_output=True, timeout=_PATIENCE_S, check=False)
            said = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        except subprocess.TimeoutExpired:
            said = [f"not read within {_PATIENCE_S:.0f} s"]
        if not out.is_file() or done.returncode:
            why = said[0] if said and "Error" in said[0] else "it is damaged"
            if "No module named" in why:
                require_extra("measurement", "h5py")
            raise InputError(f"cannot be read ({why})", where=str(path), remedy="save it as CSV")
        with np.load(out) as file:
            about = json.loads(str(file[ABOUT]))
            columns = [np.asarray(file[str(k)], dtype=np.float64) for k in range(len(about["names"]))]
    names = about["names"]
    return about["form"], dict(zip(names, columns, strict=True)), dict(zip(names, about["units"], strict=True))
