"""Input and output as the delay identification sees them: checked, centred, with what is known of the past input."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from autotune.arrays import FloatArray, is_constant
from autotune.errors import IdentificationError, InputError
from autotune.models import Hold
from autotune.recording import Recording

#: What u was before the record: not known (rows that would need it are left out), its first value, or zero.
PastInput: TypeAlias = Literal["unknown", "held", "zero"]

_GAP = 25.0  # median steps: stamps drawn at random stay below, a piece cut out does not


@dataclass(frozen=True, kw_only=True, eq=False)
class DelayData:
    """Input and output with their own time stamps, relative to an operating point.

    Attributes
    ----------
    tu, u : (M,) array
        Time stamps [s] and input less ``u_0``.
    ty, y : (N,) array
        Time stamps [s] and output less ``y_0``.
    linear : bool
        Whether the input runs linearly between its stamps; held otherwise.
    before : float or None
        Input before ``tu[0]`` less ``u_0``; None where it is not known.
    u_0, y_0 : float
        What was subtracted.
    name : str
        Where the data came from, for messages.
    """

    tu: FloatArray
    u: FloatArray
    ty: FloatArray
    y: FloatArray
    linear: bool
    before: float | None
    u_0: float = 0.0
    y_0: float = 0.0
    name: str = "recording"

    @property
    def duration_s(self) -> float:
        """Time that the input and the output cover together [s]."""
        return float(max(self.ty[-1], self.tu[-1]) - min(self.ty[0], self.tu[0]))

    def thinned(self, every: int) -> DelayData:
        """Return it with one output of so many; the input stays whole, and its response is exact at those left."""
        return replace(self, ty=self.ty[::every], y=self.y[::every])

    def usable_from(self, delay_s: float) -> DelayData:
        """Return the outputs that a delay up to this one can explain: the others need inputs nobody knows."""
        if self.before is not None:
            return self
        first = int(np.searchsorted(self.ty, self.tu[0] + delay_s - 1e-12))
        return replace(self, ty=self.ty[first:], y=self.y[first:])


def prepare(
    recording: Recording,
    *,
    hold: Hold | None = None,
    past_input: PastInput = "unknown",
    start_s: float | None = None,
    offset: bool = True,
    skip_missing: bool = False,
) -> DelayData:
    """Check a recording and bring it into the form the fits use.

    Parameters
    ----------
    recording : Recording
        What was recorded.
    hold : {"zero", "linear"}, optional
        How u runs between rows; the sidecar's ``hold`` where not given, else zero-order hold.
    past_input : {"unknown", "held", "zero"}
        What u was before the first row.
    start_s : float, optional
        Time stamp from which y is used [s]; rows before serve as the input's past.
    offset : bool
        Whether means are subtracted, for a constant that is estimated and added back.
    skip_missing : bool
        Whether rows whose y is NaN are left out, u being known; refused otherwise.

    Raises
    ------
    InputError
        NaN in u or y, or an unknown hold.
    IdentificationError
        A gap, a constant input, or an output that does not move.
    """
    recording.require_finite(("u",))
    y_from = -np.inf if start_s is None else start_s
    used = recording.t >= y_from
    if not used.any():
        raise InputError(
            f"no row from t = {start_s:g} s on", where=recording.name, remedy=f"it ends at {recording.t[-1]:g} s"
        )
    if skip_missing:
        used &= np.isfinite(recording.y)
        if not used.any():
            raise IdentificationError("no row has a y", where=recording.name, remedy="check the sensor and the link")
    replace(recording, y=np.where(used, recording.y, 0.0)).require_finite(("y",))
    hold = hold if hold is not None else recording.metadata.get("hold", "zero")
    if hold not in ("zero", "linear"):
        raise InputError(f"hold = {hold!r}", where=recording.name, remedy='it is "zero" or "linear"')
    t = _snap(recording)
    _require_no_gap(recording)
    ty, y = t[used], recording.y[used]
    _require_motion(recording.u, y, recording.name)
    u_0 = float(np.mean(recording.u)) if offset else 0.0
    y_0 = float(np.mean(y)) if offset else 0.0
    before = {"unknown": None, "held": float(recording.u[0]) - u_0, "zero": -u_0}[past_input]
    return DelayData(
        tu=t,
        u=recording.u - u_0,
        ty=np.ascontiguousarray(ty),
        y=y - y_0,
        linear=hold == "linear",
        before=before,
        u_0=u_0,
        y_0=y_0,
        name=recording.name,
    )


def _snap(recording: Recording) -> FloatArray:
    """Put stamps that were rounded when they were written back on their uniform grid."""
    t = recording.t
    grid = t[0] + (t[-1] - t[0]) / (t.size - 1) * np.arange(t.size)
    step = (t[-1] - t[0]) / (t.size - 1)
    return np.asarray(grid if np.max(np.abs(t - grid)) < 1e-4 * step else np.ascontiguousarray(t), dtype=np.float64)


def _require_no_gap(recording: Recording) -> None:
    steps = np.diff(recording.t)
    row = int(np.argmax(steps))
    if steps[row] > _GAP * np.median(steps):
        raise IdentificationError(
            f"a gap of {steps[row]:.3g} s after t = {recording.t[row]:g} s, where u is not known",
            where=recording.name,
            remedy="cut the recording there, or fill the rows with the input that acted",
        )


def _require_motion(u: FloatArray, y: FloatArray, name: str) -> None:
    if is_constant(u):
        raise IdentificationError(
            f"the input is constant (u = {u[0]:g}): neither gain nor delay show",
            where=name,
            remedy="move u: a step, a relay, or a set-point change in closed loop",
        )
    if is_constant(y):
        what = "zero" if y[0] == 0.0 else f"constant (y = {y[0]:g})"
        raise IdentificationError(
            f"the output is {what} although u moves: nothing to identify",
            where=name,
            remedy="check the sensor and the actuator, or move u further than the sensor's resolution",
        )


def input_period(data: DelayData) -> float:
    """Return the period u nearly repeats with [s], or NaN; h is then known up to half of it, with b's sign reversed.

    Notes
    -----
    Correlation above 0.9 with itself a period later, or below -0.9 half a period later, as in a limit cycle under a
    relay. Records are looked at in 8192 bins: shorter periods go unnoticed.
    """
    count = min(8192, data.tu.size)
    grid = np.linspace(data.tu[0], data.tu[-1], count)
    held = np.clip(np.searchsorted(data.tu, grid, side="right") - 1, 0, None)
    u = data.u[held] - np.mean(data.u[held])
    spectrum = np.fft.rfft(u, 2 * count)
    products = np.fft.irfft(np.abs(spectrum) ** 2)[: count // 2]
    energy = np.concatenate([[0.0], np.cumsum(u**2)])
    lags = np.arange(count // 2)
    correlation = products / np.sqrt((energy[count - lags]) * (energy[-1] - energy[lags]) + 1e-300)
    fallen = np.flatnonzero(np.abs(correlation) < 0.5)
    if fallen.size == 0:
        return float("nan")
    again = np.flatnonzero(np.abs(correlation[fallen[0] :]) > 0.9)
    if again.size == 0:
        return float("nan")
    first = fallen[0] + int(again[0])
    while first + 1 < correlation.size and abs(correlation[first + 1]) > abs(correlation[first]):
        first += 1
    return float((2.0 if correlation[first] < 0 else 1.0) * first * (grid[1] - grid[0]))
