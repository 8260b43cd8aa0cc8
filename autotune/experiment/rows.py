"""The rows of a running recording: all of them on the disk, the latest in memory too."""

from __future__ import annotations

import math
from array import array
from pathlib import Path

import numpy as np

from autotune.arrays import FloatArray
from autotune.recording import as_written, read_recording

#: rows that are kept in memory at least; up to twice as many are
KEPT_ROWS = 100_000


class RecentRows:
    """Rows as estimates want them, in memory that does not grow with the time on the rig.

    They are the values on the disk, to the last digit: what is computed from them is computed from the file again.

    Parameters
    ----------
    path : Path
        The recording, from which older rows are read again; every row must be on the disk before it is put here.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._columns = tuple(array("d") for _ in range(3))
        self._first = 0  # number of the oldest row in memory
        self.unusable = 0

    def append(self, t_s: float, u: float, y: float) -> None:
        """Put a row.

        Parameters
        ----------
        t_s : float
            Stamp [s].
        u : float
            Command [u unit].
        y : float
            Measurement [y unit], NaN where the sample was unusable.
        """
        self.unusable += math.isnan(y)
        for column, value in zip(self._columns, (t_s, u, y), strict=True):
            column.append(as_written(value))
        if len(self._columns[0]) >= 2 * KEPT_ROWS:
            self._first += KEPT_ROWS
            for column in self._columns:
                del column[:KEPT_ROWS]

    def __len__(self) -> int:
        return self._first + len(self._columns[0])

    @property
    def last_s(self) -> float:
        """Time of the last row [s]; minus infinity where there is none."""
        return self._columns[0][-1] if self._columns[0] else -math.inf

    def since(self, start: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return t, u, y of the rows from number ``start`` on, (N,) each."""
        if start < self._first:
            written = read_recording(self._path)
            return written.t[start:], written.u[start:], written.y[start:]
        t, u, y = (np.array(column[start - self._first :], dtype=np.float64) for column in self._columns)
        return t, u, y
