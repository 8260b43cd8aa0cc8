"""A found effect as a law over its signal: the curve with its band, and what the data say in bins around it.

The bins do not come from the curve: what the extended model leaves of the readings is traced back through the model
to where the effect acts, bin by bin of its signal, and added to the curve (component plus residual). Where the
law is right the bins lie on it to within their bars; where it is not they leave it, and show what it should be.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.evidence.residual import last_move

#: Bins over the signal: as many of these as the data tell apart; rows of a bin at least; points of the curve.
BINS, LEAST_ROWS, POINTS = (12, 8, 5, 3, 2), 20, 161
#: Share of the bins that must tell something.
INFORMATIVE = 0.7
#: Share of the signal's rows left out at either end of the curve.
TAIL = 0.002
#: 1-sigma of a bin, in sizes of the law: up to which it tells something, and beyond which it is not shown.
TELLS, WIDEST = 0.25, 0.8
#: Rows of a recording at which it is said what an effect adds.
ROWS = 6000
#: Step of the search by which the band is differentiated.
NUDGE = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Branch:
    """One branch of a law, as signals go up, go down, or either way.

    Attributes
    ----------
    name : {"", "rising", "falling"}
        Which way the signal goes; "" where that does not matter.
    x, law, sd : (K,) array
        Signal, law there and its 1-sigma from the effect's own numbers.
    at, found, error : (B,) array
        Mean signal of each bin, what the data say there, and its 1-sigma; bins that tell nothing are left out.
    rows : (B,) int array
        Rows in each bin.
    """

    name: str
    x: FloatArray
    law: FloatArray
    sd: FloatArray
    at: FloatArray
    found: FloatArray
    error: FloatArray
    rows: IntArray


@dataclass(frozen=True, kw_only=True, eq=False)
class MissingLaw:
    """An effect as a law over a signal.

    Attributes
    ----------
    effect : str
        Its name.
    signal, unit : str
        What it is drawn over, with its unit.
    value, value_unit : str
        What it gives, with its unit.
    is_whole : bool
        Whether the characteristic is shown whole, so that the model without it gives the signal itself; else what is
        added, so that the model without it gives zero.
    branches : tuple of Branch
        One, or two for an effect with a memory.
    acts : tuple of (N,) array
        What it adds at every row, per recording; thinned to ``rows`` of each.
    rows : tuple of (N,) int array
        The rows of each recording at which that is said.
    """

    effect: str
    signal: str
    unit: str
    value: str
    value_unit: str
    is_whole: bool
    branches: tuple[Branch, ...]
    acts: tuple[FloatArray, ...]
    rows: tuple[IntArray, ...]


class LawLine(ABC):
    """A fitted effect as a function of one signal, whatever the model is written as."""

    @property
    @abstractmethod
    def name(self) -> str:
        """The effect's name."""

    @property
    @abstractmethod
    def words(self) -> tuple[str, str, str, str]:
        """The signal that it is drawn over with its unit, and what it gives with its unit."""

    @property
    @abstractmethod
    def is_whole(self) -> bool:
        """Whether it is a characteristic from its signal to the same quantity, else something that is added."""

    @property
    def remembers(self) -> bool:
        """Whether what it does depends on the way that its signal came."""
        return False

    @property
    def turns_round(self) -> bool:
        """Whether it may turn round where its signal changes sign."""
        return True

    @abstractmethod
    def values(self) -> list[FloatArray]:
        """Return the signal, (N,) per recording; all finite."""

    @abstractmethod
    def counts(self) -> BoolArray:
        """Return the rows, all recordings one after the other, that count."""

    @abstractmethod
    def law(self, x: FloatArray, theta: FloatArray, number: int = 0) -> FloatArray:
        """Return what it gives as its signal passes values, (K,), at numbers of the fit, in a recording."""

    @abstractmethod
    def numbers(self) -> tuple[FloatArray, list[int], FloatArray]:
        """Return the fit's numbers, which of them are the effect's own, and the covariance of these."""

    @abstractmethod
    def traced_back(self, bins: Sequence[BoolArray]) -> tuple[FloatArray, FloatArray]:
        """Return how much, added where it acts at the rows of each bin, explains the residual best, and its 1-sigma."""


def law_of(line: LawLine | None) -> MissingLaw | None:
    """Return a fitted effect as a law over its signal.

    Parameters
    ----------
    line : LawLine, optional
        The effect as a function of one signal, where it is one.

    Returns
    -------
    MissingLaw or None
        None for an effect that is no law over one signal (lags, dead times, stops, rates), or whose signal stands
        still.

    Notes
    -----
    First order: the residual is traced back through the model at the fit, and the other numbers are held, so that the
    bars are those of the bins alone. Where a curve that changes the dynamics is far off, the bins go a part of the way
    to the true law; at the right law they are on it. Rows whose errors go together count as one.

    References
    ----------
    Larsen and McCleary, Technometrics 14, 1972: partial residual plots; Cook, Technometrics 35, 1993.
    """
    if line is None:
        return None
    signal, counts, theta = line.values(), line.counts(), line.numbers()[0]
    x = np.concatenate(signal)[counts]
    if x.size < 2 * LEAST_ROWS or not np.ptp(x) > 0.0:
        return None
    rows = tuple(np.unique(np.linspace(0, s.size - 1, min(s.size, ROWS)).astype(np.int64)) for s in signal)
    acts = [line.law(s[k], theta, i) for i, (s, k) in enumerate(zip(signal, rows, strict=True))]
    if line.is_whole:
        acts = [a - s[k] for a, s, k in zip(acts, signal, rows, strict=True)]
    over, unit, value, value_unit = line.words
    return MissingLaw(
        effect=line.name, signal=over, unit=unit, value=value, value_unit=value_unit, is_whole=line.is_whole,
        branches=tuple(_branch(line, way) for way in (("rising", "falling") if line.remembers else ("",))),
        acts=tuple(acts), rows=rows,
    )  # fmt: skip


def _branch(line: LawLine, way: str) -> Branch:
    """Return one branch: the curve with its band, and the bins."""
    every, counts, theta = np.concatenate(line.values()), line.counts(), line.numbers()[0]
    low, high = np.quantile(every[counts], [TAIL, 1.0 - TAIL])
    if way:
        # down and up again: what it remembers is then what a signal that comes from the far end leaves
        path = np.concatenate([np.linspace(high, low, POINTS), np.linspace(low, high, POINTS)])
        path = path if way == "rising" else (low + high) - path
        keep: slice | FloatArray = slice(POINTS, None)
    else:
        path, keep = np.linspace(low, high, POINTS), slice(None)
    law = line.law(path, theta)[keep]
    x = path[keep]
    sd = _band(line, path)[keep]
    order = np.argsort(x)
    at, found, error, rows = _bins(line, way, (low, high), (x[order], law[order]))
    return Branch(name=way, x=x[order], law=law[order], sd=sd[order], at=at, found=found, error=error, rows=rows)


def _band(line: LawLine, x: FloatArray) -> FloatArray:
    """Return the law's 1-sigma by the effect's own numbers."""
    theta, own, covariance = line.numbers()
    if not own:
        return np.zeros(x.size)
    columns = []
    for i in own:
        step = np.where(np.arange(theta.size) == i, NUDGE, 0.0)
        columns.append((line.law(x, theta + step) - line.law(x, theta - step)) / (2.0 * NUDGE))
    D = np.column_stack(columns)
    return np.asarray(np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", D, covariance, D), 0.0)))


def _edges(x: FloatArray, bins: int, turns: bool) -> FloatArray:
    """Return edges of bins: half way between equal rows and equal widths; one at 0 where the law turns round there."""
    shares = np.linspace(0.0, 1.0, bins + 1)
    even = x.min() + np.ptp(x) * shares
    edges = 0.5 * (np.quantile(x, shares) + even)
    if turns and edges[0] < 0.0 < edges[-1]:
        edges[1 + int(np.argmin(np.abs(edges[1:-1])))] = 0.0
    return np.unique(edges)


def _bins(
    line: LawLine, way: str, ends: tuple[float, float], curve: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Return mean signal, value, 1-sigma and rows of every bin that tells something."""
    signal, counts = np.concatenate(line.values()), line.counts()
    if way:
        counts = counts & ((np.concatenate([last_move(s) for s in line.values()]) > 0.0) == (way == "rising"))
    counts = counts & (signal >= ends[0]) & (signal <= ends[1])
    none = np.zeros(0)
    if counts.sum() < 2 * LEAST_ROWS:
        return none, none, none, np.zeros(0, dtype=np.int64)
    size = float(np.ptp(curve[1])) or float(np.max(np.abs(curve[1]))) or 1.0
    tried = []
    for bins in BINS:
        members = list(_members(signal, counts, _edges(signal[counts], bins, line.turns_round)))
        if not members:  # steps that the signal stands on between a few scattered values fill no bin alone
            continue
        deviation, error = line.traced_back(members)
        tried.append((members, deviation, error))
        if np.mean(error < TELLS * size) >= INFORMATIVE:
            break
    else:
        if not tried:
            return none, none, none, np.zeros(0, dtype=np.int64)
        members, deviation, error = min(tried, key=lambda one: float(np.median(one[2])))
    tells = error < WIDEST * size
    at = np.array([signal[m & counts].mean() for m in members])
    own = np.interp(at, *curve)  # the deviation belongs to the bin's mean signal
    rows = np.array([int((m & counts).sum()) for m in members], dtype=np.int64)
    return at[tells], (own + deviation)[tells], error[tells], rows[tells]


def _members(signal: FloatArray, counts: BoolArray, edges: FloatArray) -> Iterator[BoolArray]:
    """Yield the rows of every bin in which enough rows count; those that do not count are in their bin all the same."""
    number = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, edges.size - 2)
    for k in range(edges.size - 1):
        member = number == k
        if (member & counts).sum() >= LEAST_ROWS:
            yield member
