"""Recordings: read, append row by row, slice, resample.

The format is CSV with a header ``t,u,y`` and optional further columns, and an optional TOML sidecar of the same
name. ``u`` is the command held from its row's time until the next row; ``y`` is the measurement taken at that
row's time, before that row's ``u`` acts. Lines beginning with ``#`` are comments.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

import numpy as np
import tomli_w
from scipy.optimize import minimize_scalar

from autotune.arguments import check_arguments
from autotune.arrays import BoolArray, FloatArray, is_constant, is_real
from autotune.errors import InputError
from autotune.text_files import check_path, printable, read_toml
from autotune.whole_files import append_whole, write_whole

#: Largest size of a value that is computed with: far beyond every unit, far from where squares overflow.
LARGEST = 1e15
#: Time between two samples that no clock tells apart [s].
CLOSEST_S = 1e-12

#: An even grid may have so many rows, and ten times those of the recording.
_MOST_NEW_ROWS = 100_000
#: Times its rows that a recording's time may hold where it is simulated from end to end.
_MOST_GAPS = 100
#: Sample times after each other that a slow link may turn into one step, as a rule.
_LATEST = 5.0
_REQUIRED = ("t", "u", "y")


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """What a rig did: time stamps, held commands, measurements and any further named signals.

    Attributes
    ----------
    t : (N,) array
        Time stamps in seconds, strictly increasing, not necessarily uniform.
    u, y : (N,) array
        Command held from each row's time on, and measurement before that command acts. ``y`` and the extra
        columns may hold NaN where a sample was bad; ``t`` may not.
    extra : mapping of str to (N,) array
        Further columns: ``r`` set-point, ``u_applied`` read back from the device, any named internal signal.
    metadata : mapping
        The sidecar: units, rig, relay settings, why the recording ended.
    name : str
        Where it came from, for messages.

    Raises
    ------
    InputError
        Columns of unequal length, fewer than two rows, or time that does not increase; the row is named.
    """

    t: FloatArray
    u: FloatArray
    y: FloatArray
    extra: Mapping[str, FloatArray] = field(default_factory=lambda: MappingProxyType({}))
    metadata: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    name: str = "recording"

    def __post_init__(self) -> None:
        for column, values in {"t": self.t, "u": self.u, "y": self.y}.items():
            if not isinstance(values, np.ndarray) or values.ndim != 1 or values.dtype.kind not in "fiu":
                raise InputError(
                    f"column {column!r} is no row of numbers",
                    where=str(self.name),
                    remedy="give an array; autotune.read takes lists and tables",
                )
        if not isinstance(self.extra, Mapping) or not isinstance(self.metadata, Mapping):
            raise InputError("extra and metadata must be mappings", where=str(self.name), remedy="leave them out")
        for column, values in self.extra.items():
            if not isinstance(column, str) or not isinstance(values, np.ndarray):
                raise InputError(f"extra column {column!r} is no array"[:99], where=str(self.name), remedy="convert it")
        odd = next((column for column in self.extra if not column.isprintable() or len(column) > 200), None)
        if odd is not None:
            raise InputError(
                f"the column name {printable(odd[:40])!r}",
                where=self.name,
                remedy="give names of at most 200 characters, none of them a control character",
            )
        for column, values in {"u": self.u, "y": self.y, **self.extra}.items():
            if values.shape != self.t.shape:
                raise InputError(
                    f"column {column!r} has {values.size} rows, t has {self.t.size}",
                    where=self.name,
                    remedy="give every column the same number of rows",
                )
        if self.t.size < 2:
            raise InputError(f"{self.t.size} row(s)", where=self.name, remedy="a recording needs at least two rows")
        steps = np.diff(self.t)
        if not np.all(steps > 0):  # also catches NaN
            row = int(np.argmax(~(steps > 0))) + 1
            raise InputError(
                f"time does not increase at data row {row + 1} (t = {self.t[row]:g} after {self.t[row - 1]:g})",
                where=self.name,
                remedy="sort the rows by t and drop repeated stamps",
            )
        if not float(np.min(steps)) >= CLOSEST_S:
            row = int(np.argmin(steps)) + 1
            raise InputError(
                f"data rows {row} and {row + 1} are {steps[row - 1]:g} s apart, closer than any two samples are",
                where=self.name,
                remedy="write t in seconds",
            )

    def __len__(self) -> int:
        return int(self.t.size)

    @property
    def sample_time_s(self) -> float:
        """Median step between rows [s]."""
        return float(np.median(np.diff(self.t)))

    @property
    def stated_sample_time_s(self) -> float:
        """Sample time as the recording's metadata state it, else the median step [s]."""
        return float(self.metadata.get("sample_time_s", self.sample_time_s))

    @property
    def duration_s(self) -> float:
        """Time from the first row to the end of the last row's hold [s]."""
        return float(self.t[-1] - self.t[0]) + self.sample_time_s

    @property
    def is_uniform(self) -> bool:
        """Whether every step is within 1 % of the median step."""
        steps = np.diff(self.t)
        return bool(np.all(np.abs(steps - np.median(steps)) <= 0.01 * np.median(steps)))

    def __getitem__(self, column: str) -> FloatArray:
        """Return a column by its name in the file."""
        columns = {"t": self.t, "u": self.u, "y": self.y, **self.extra}
        if column not in columns:
            raise InputError(f"no column {column!r}", where=self.name, remedy=f"it has {', '.join(columns)}")
        return columns[column]

    def require_dense(self) -> None:
        """Refuse a recording whose time is nearly all gaps: a free run through them takes as long as if it were rows.

        Raises
        ------
        InputError
            Its time would hold a hundred times the rows that it has, or more.
        """
        rows = self.duration_s / self.sample_time_s
        if rows > _MOST_GAPS * len(self):
            raise self._mostly_gap(f"{len(self)} rows in a time that would hold {rows:.3g}", " and give both parts")

    def _mostly_gap(self, said: str, further: str = "") -> InputError:
        longest = float(np.max(np.diff(self.t)))
        what = f"{said}: the longest gap has {longest:g} s"
        return InputError(what, where=self.name, remedy=f"cut the recording at the gap{further}")

    def between(self, start_s: float, end_s: float) -> Recording:
        """Return the rows with ``start_s <= t < end_s``, time stamps unchanged.

        Parameters
        ----------
        start_s, end_s : float
            In the recording's own time stamps [s]; infinite where there is no end.

        Raises
        ------
        InputError
            One of them is not a number.
        """
        if not (is_real(start_s) and is_real(end_s)):
            said = f"from {start_s!r} to {end_s!r}"[:200]
            raise InputError(said, where=self.name, remedy="give two times in s, infinite where there is no end")
        return self.only((self.t >= start_s) & (self.t < end_s))

    def only(self, keep: Any) -> Recording:
        """Return some of the rows, by number or by mask."""
        try:
            t = self.t[keep]
        except (IndexError, TypeError, ValueError) as error:
            remedy = "give numbers of rows, a slice or a mask"
            raise InputError(f"keep: {error}", where=self.name, remedy=remedy) from None
        extra = {name: values[keep] for name, values in self.extra.items()}
        return replace(self, t=t, u=self.u[keep], y=self.y[keep], extra=MappingProxyType(extra))

    @property
    def first_reading(self) -> int:
        """Row of the first reading; 0 where there is none."""
        return int(np.argmax(np.isfinite(self.y)))

    def told_from_s(self, late_s: float) -> float:
        """Return the time from which commands of the recording act behind a dead time, its middle at the latest [s].

        Those that were given before it began are on their way until then, and are not known.
        """
        return float(self.t[0] + min(late_s, 0.5 * self.duration_s))

    @check_arguments
    def read_from(self, row: int) -> Recording:
        """Return the recording without the readings before a row; what was commanded before it stays."""
        y = np.array(self.y, dtype=float)
        y[:row] = np.nan
        return replace(self, y=y)

    @check_arguments
    def resampled(self, dt_s: float) -> Recording:
        """Return the recording on a uniform grid: commands held, other columns linearly interpolated.

        Parameters
        ----------
        dt_s : float
            Step of the new grid [s].

        Notes
        -----
        Interpolation filters the noise of ``y`` and attenuates content near the Nyquist frequency; use the
        recorded stamps wherever a method can.
        """
        if not dt_s > 0.0:
            raise InputError(f"dt_s = {dt_s:g}", where=self.name, remedy="the step of the new grid must be positive")
        rows = (float(self.t[-1]) - float(self.t[0])) / dt_s + 1.0
        if rows > _MOST_NEW_ROWS + 10.0 * len(self):
            raise self._mostly_gap(f"an even grid of {dt_s:g} s needs {rows:.3g} rows for {len(self)}")
        t = self.t[0] + dt_s * np.arange(int(np.floor((self.t[-1] - self.t[0]) / dt_s + 1e-9)) + 1)
        held = np.clip(np.searchsorted(self.t, t + 1e-9 * dt_s, side="right") - 1, 0, None)
        extra = {
            name: values[held] if name == "u_applied" else np.interp(t, self.t, values)
            for name, values in self.extra.items()
        }
        return replace(self, t=t, u=self.u[held], y=np.interp(t, self.t, self.y), extra=MappingProxyType(extra))

    def at_even_times(self) -> Recording:
        """Return the recording with its rows evenly spaced: where stamps were late, at the times they are late of.

        Notes
        -----
        A row cannot arrive before it was taken: of all lines a + b k below the stamps that of least mean lateness is
        taken. The first stamp and the last one alone would be wrong by how late these two happen to be.

        References
        ----------
        Moon, Skelly and Towsley, Estimation and removal of clock skew from network delay measurements, Infocom 1999.
        """
        number = np.arange(len(self), dtype=float)
        mean = (self.t[-1] - self.t[0]) / (len(self) - 1)

        def earliest(b: float) -> float:
            return float(np.min(self.t - b * mean * number))

        def lateness(b: float) -> float:  # convex, with a kink at its minimum
            return float(np.mean(self.t - b * mean * number)) - earliest(b)

        found = minimize_scalar(lateness, bounds=(0.5, 2.0), method="bounded", options={"xatol": 1e-12})
        b = 1.0 if lateness(1.0) <= found.fun else float(found.x)  # even ones stay as they are
        return replace(self, t=earliest(b) + b * mean * number)

    @check_arguments
    def standing_still(self, rows: BoolArray, columns: Sequence[str] = ("u",)) -> Recording:
        """Return the recording with commands that stand still, at their mean, through each run of some rows.

        Parameters
        ----------
        rows : (N,) bool array
            The rows.
        columns : sequence of str
            The commands.

        Returns
        -------
        Recording
            Itself where no command moves in such a run.
        """
        edges = np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(np.int8))).reshape(-1, 2)
        still = {name: self[name].copy() for name in columns}
        moving = [(x, a, b) for x in still.values() for a, b in edges if np.ptp(x[a:b]) > 0.0]
        for x, a, b in moving:
            x[a:b] = x[a:b].mean()
        u = still.pop("u", self.u)
        return replace(self, u=u, extra=MappingProxyType({**self.extra, **still})) if moving else self

    @check_arguments
    def require_finite(self, columns: Iterable[str] = ("u", "y")) -> Recording:
        """Return self if the columns hold no NaN or infinity.

        Raises
        ------
        InputError
            Names the first bad row and how many there are.
        """
        for column in columns:
            bad = ~np.isfinite(self[column])
            if bad.any():
                row = int(np.argmax(bad))
                raise InputError(
                    f"column {column!r} is not a number in {int(bad.sum())} row(s), first at t = {self.t[row]:g} s",
                    where=self.name,
                    remedy="cut the recording there or fill the gap with measured values",
                )
        return self


def usable(recording: Recording, *, moving: bool = True) -> Recording:
    """Return a recording from outside if arithmetic can hold it and it holds something to learn from.

    Parameters
    ----------
    recording : Recording
        As it was read.
    moving : bool
        Whether y must change: nothing can be identified from one that does not.

    Raises
    ------
    InputError
        A size beyond 1e15, no y at all, or a constant one; names the column and the row.
    """
    for column in ("t", "u", "y", *recording.extra):
        values = np.abs(recording[column])
        over = np.isfinite(values) & (values > LARGEST)
        if over.any():
            at = float(recording.t[int(np.argmax(over))])
            raise InputError(
                f"column {column!r} exceeds {LARGEST:g} in {int(over.sum())} row(s), first at t = {at:g} s",
                where=recording.name,
                remedy="check the unit, or delete the rows",
            )
    y = recording.y[np.isfinite(recording.y)]
    if y.size < 2:
        raise InputError("column 'y' has no numbers", where=recording.name, remedy="give a recording with measurements")
    if moving and is_constant(y):
        raise InputError(
            f"column 'y' is constant ({y[0]:g}): nothing can be learnt from it",
            where=recording.name,
            remedy="check the column and the sensor, or record an experiment that moves y",
        )
    return recording


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Read ``NAME.csv`` and, where it exists, its sidecar ``NAME.toml``.

    A last line without its line end was cut off while it was written: it is dropped, since even its last digit
    could be missing.

    Raises
    ------
    InputError
        No such file, no ``t,u,y`` header, a cell that is not a number (names the line), or a sidecar that is none or
        states a sample time that the rows contradict.
    """
    path = check_path(path)
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path), remedy="check the path") from None
    if not text.endswith("\n"):
        text = text[: text.rfind("\n") + 1]
    lines = text.splitlines()
    header_at = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    header = [] if header_at is None else [cell.strip() for cell in lines[header_at].split(",")]
    missing = [column for column in _REQUIRED if column not in header]
    if header_at is None or missing:
        raise InputError(
            f"the header lacks {', '.join(missing)}",
            where=str(path),
            remedy="write it in the project's form with autotune import FILE --out REC.csv",
        )
    if len(set(header)) != len(header):
        raise InputError("the header names a column twice", where=str(path), remedy="give each column its own name")
    values = _parse(lines, header_at, len(header), path)
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(header)}
    t, u, y = (columns.pop(name) for name in _REQUIRED)
    metadata = read_sidecar(path)
    recording = Recording(t=t, u=u, y=y, extra=MappingProxyType(columns), metadata=metadata, name=str(path))
    _require_own_steps(recording, path)
    return recording


def _require_own_steps(recording: Recording, path: Path) -> None:
    """Refuse a sidecar whose sample time the rows contradict: rows may be late, and never come early."""
    stated = recording.metadata.get("sample_time_s", recording.sample_time_s)
    where = str(path.with_suffix(".toml"))
    if isinstance(stated, bool) or not isinstance(stated, int | float):
        raise InputError(f"sample_time_s = {stated!r}", where=where, remedy="write a number of seconds")
    if not 0.9 * stated <= recording.sample_time_s <= _LATEST * stated:
        raise InputError(
            f"sample_time_s = {stated:g}, and the rows of {path.name} are {recording.sample_time_s:g} s apart",
            where=where,
            remedy="correct or delete the line",
        )


def _parse(lines: Sequence[str], header_at: int, width: int, path: Path) -> FloatArray:
    body = lines[header_at + 1 :]
    try:
        with io.StringIO("\n".join(body)) as stream:
            if not any(line.strip() and not line.startswith("#") for line in body):
                return np.empty((0, width))
            values: FloatArray = np.loadtxt(stream, delimiter=",", comments="#", ndmin=2, dtype=np.float64)
        if values.shape[1] == width:
            return values
    except ValueError:
        pass
    return _parse_slowly(body, header_at, width, path)


def _parse_slowly(body: Sequence[str], header_at: int, width: int, path: Path) -> FloatArray:
    """Parse again row by row: empty cells become NaN, and what is wrong is named by its line."""
    rows: list[list[float]] = []
    for number, line in enumerate(body, start=header_at + 2):
        if not line.strip() or line.startswith("#"):
            continue
        cells = line.split(",")
        try:
            if len(cells) != width:
                raise ValueError(f"{len(cells)} cells where the header has {width}")
            rows.append([_number(cell) for cell in cells])
        except ValueError as error:
            raise InputError(str(error), where=f"{path} line {number}", remedy="correct or delete the line") from None
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _number(cell: str) -> float:
    """Return a cell as a number, NaN for an empty one; ``1_000``, which Python takes for 1000, is none."""
    if "_" in cell:
        raise ValueError(f"could not convert {cell.strip()!r} to a number")
    return float(cell) if cell.strip() else np.nan


def is_own_form(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is text whose first line that is no comment names the columns t, u and y with commas.

    A file that cannot be read is taken as one, so that reading it says why.
    """
    if Path(path).suffix.lower() not in ("", ".csv", ".txt", ".part"):
        return False
    try:
        with open(path, encoding="utf-8-sig", errors="replace") as file:
            said = (line for line in file if line.strip() and not line.startswith("#"))
            first, second = next(said, ""), next(said, "")
    except OSError:
        return True
    header = [cell.strip() for cell in first.split(",")]
    dates = "t" in header and len(cells := second.split(",")) == len(header) and ":" in cells[header.index("t")]
    return not first or (set(header).issuperset(_REQUIRED) and not dates)


def read_sidecar(path: Path) -> Mapping[str, Any]:
    """Return what the TOML file of the same name says; nothing where there is none."""
    sidecar = path.with_suffix(".toml")
    if not sidecar.is_file():
        return MappingProxyType({})
    content = read_toml(sidecar)
    model = next((key for key in ("block", "state", "fmu") if key in content), None)
    if model is not None:
        raise InputError(
            f"is a model ({model}), and no sidecar",
            where=str(sidecar),
            remedy="give the model another name than the CSV",
        )
    if content.get("hold", "zero") not in ("zero", "linear"):
        raise InputError(
            f"hold = {content['hold']!r}", where=str(sidecar), remedy='write hold = "zero" or hold = "linear"'
        )
    units = content.get("units", {})
    if not isinstance(units, dict) or not all(isinstance(unit, str) for unit in units.values()):
        raise InputError(
            "[units] holds what is no text", where=str(sidecar), remedy='write the unit of each column, as in u = "V"'
        )
    return MappingProxyType(content)


def as_written(value: float) -> float:
    """Return a value as it is read back from a recording."""
    return float(_text(value))


def _text(value: float) -> str:
    return format(value, ".12g")


class RecordingWriter:
    """Append-only writer: each row is with the operating system before :meth:`append` returns.

    A process that is killed leaves a readable recording up to its last row. Use it as a context manager.

    Parameters
    ----------
    path : path
        The CSV to create; an existing one is refused, so that no recording is ever overwritten.
    columns : sequence of str
        Header, beginning with ``t, u, y``.
    metadata : mapping
        First content of the sidecar; :meth:`note` and :meth:`finish` add to it.
    """

    def __init__(
        self, path: str | os.PathLike[str], columns: Sequence[str], metadata: Mapping[str, Any] | None = None
    ) -> None:
        if tuple(columns[:3]) != _REQUIRED:
            raise InputError("columns must begin with t, u, y", where="RecordingWriter")
        self.path = Path(path)
        self._width = len(columns)
        self._metadata = dict(metadata or {})
        try:
            self._file = open(self.path, "xb", buffering=0)  # noqa: SIM115 - closed by close()
        except FileExistsError:
            raise InputError(
                "a recording is already there", where=str(self.path), remedy="choose another --out"
            ) from None
        try:
            append_whole(self._file, (",".join(columns) + "\n").encode())
            self._write_sidecar()
        except BaseException:
            self._file.close()
            self.path.unlink(missing_ok=True)
            raise

    def append(self, row: Sequence[float]) -> None:
        """Write one row, NaN for what is not known."""
        if len(row) != self._width:
            raise ValueError(f"{len(row)} values for {self._width} columns")
        append_whole(self._file, (",".join(map(_text, row)) + "\n").encode())

    def comment(self, text: str) -> None:
        """Write a comment line, for a person who reads the file."""
        append_whole(self._file, f"# {text}\n".replace("\r", " ").encode())

    def note(self, metadata: Mapping[str, Any]) -> None:
        """Add what is known so far to the sidecar; a process killed later leaves it there; no disk is waited for."""
        self._metadata |= metadata
        self._write_sidecar(sync=False)

    def finish(self, metadata: Mapping[str, Any]) -> None:
        """Add to the sidecar why the recording ended and what else is known, and close."""
        self._metadata |= metadata
        self._write_sidecar()
        self.close()

    def close(self) -> None:
        """Bring the file to the disk and close it; harmless when closed already."""
        if not self._file.closed:
            try:
                os.fsync(self._file.fileno())
            finally:
                self._file.close()

    def _write_sidecar(self, *, sync: bool = True) -> None:
        write_whole(self.path.with_suffix(".toml"), tomli_w.dumps(self._metadata), sync=sync)

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def write_recording(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a whole recording and its sidecar, replacing what is there.

    Parameters
    ----------
    recording : Recording
        N rows; its metadata become the sidecar.
    path : path
        The CSV file; the sidecar lies beside it with the ending ``.toml``.
    """
    path = Path(path)
    columns = {"t": recording.t, "u": recording.u, "y": recording.y, **recording.extra}
    rows, text = np.column_stack(list(columns.values())), io.StringIO()
    np.savetxt(text, rows, fmt="%.12g", delimiter=",", header=",".join(columns), comments="")
    write_whole(path, text.getvalue())
    if recording.metadata:
        write_whole(path.with_suffix(".toml"), tomli_w.dumps(dict(recording.metadata)))
