"""An effect of equations as a law over its signal, with what the data say in bins around it.

As for a chain: what the extended model leaves of the readings is traced back to where the effect acts, bin by bin of
its signal, and added to the curve (component plus residual); the other numbers are held. What a bin adds is simulated:
an indicator of its rows drives the place of the effect as a measured input would.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.equations.bench import Outcome
from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.diagnosis.equations.scores import noise_of
from autotune.diagnosis.equations.sizes import units_at
from autotune.diagnosis.evidence.missing_law import BINS, LEAST_ROWS, POINTS, ROWS, TAIL, WIDEST, Branch, MissingLaw
from autotune.effects import KINDS
from autotune.equations.effects import (
    compile_with,
    form_of,
    local_names,
    prefix_of,
    text_of,
    where_of,
    with_values,
)
from autotune.equations.expressions import Call, Expression, Name, Number, names_in, parse, substituted, to_text
from autotune.equations.model import EquationModel, Extension, InputColumn, State
from autotune.equations.parameter_scales import slopes_of
from autotune.equations.simulate import compile_model, derivatives, drive_of, simulate
from autotune.models import Effect

#: Name of the column that marks a bin's rows, and its size in sizes of the law: small, for the first order is asked.
MARK, SMALL = "rows_of_a_bin", 0.05
#: Step of a number, in its standard deviations, by which the band is differentiated.
NUDGE = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class _Line:
    """A fitted effect whose text is a law over one signal."""

    bench: EquationBench
    outcome: Outcome
    number: int
    over: str
    signals: tuple[FloatArray, ...]

    @property
    def effect(self) -> Effect:
        return self.outcome.effects[self.number]

    @property
    def is_whole(self) -> bool:
        """Whether it puts something in the place of its signal, and adds nothing to it."""
        return self.over == "value"

    def law(self, x: FloatArray, effect: Effect | None = None) -> FloatArray:
        """Return what the effect gives at values of its signal."""
        effect = self.effect if effect is None else effect
        values = {key: q.value for key, q in effect.parameters.items()}

        def bound(name: str) -> Expression | None:
            if name == self.over:
                return Name("x")
            if name in ("pi", "t"):
                return None
            q = KINDS[effect.name].quantity(name)
            neutral = form_of(effect, self.bench.model).defaults.get(name, None if q is None else q.neutral)
            return Number(float(values.get(name, 0.0 if neutral is None else neutral)))

        text = text_of(form_of(effect, self.bench.model), effect)
        shell = EquationModel(
            name="law", inputs=(InputColumn(column="x"),), output=substituted(parse(text), bound), parameters=(),
            states=(State(name="nothing", derivative=Name("nothing"), start=0.0),),
        )  # fmt: skip
        compiled = compile_model(shell)
        points = np.atleast_2d(x).T
        return np.asarray(derivatives(compiled, compiled.parameter_vector, np.zeros((x.size, 1)), points)[1][:, 0])


def law_in_equations(bench: EquationBench, outcome: Outcome, number: int) -> MissingLaw | None:
    """Return a fitted effect as a law over its signal.

    Parameters
    ----------
    bench : EquationBench
        The model on its recordings.
    outcome : Outcome
        The fit.
    number : int
        The effect's position among those of the fit.

    Returns
    -------
    MissingLaw or None
        None for an effect that has a memory, goes with the time or with several signals, or whose signal stands still.
    """
    line = _line_of(bench, outcome, number)
    if line is None:
        return None
    counts = [np.isfinite(r.y) & np.isfinite(s) for r, s in zip(bench.recordings, line.signals, strict=True)]
    x = np.concatenate([s[ok] for s, ok in zip(line.signals, counts, strict=True)])
    if x.size < 2 * LEAST_ROWS or not np.ptp(x) > 0.0:
        return None
    low, high = np.quantile(x, [TAIL, 1.0 - TAIL])
    grid = np.linspace(low, high, POINTS)
    at, found, error, rows = _bins(line, counts, grid)
    branch = Branch(
        name="", x=grid, law=line.law(grid), sd=_band(line, grid), at=at, found=found, error=error, rows=rows
    )  # fmt: skip
    shown = tuple(np.unique(np.linspace(0, s.size - 1, min(s.size, ROWS)).astype(np.int64)) for s in line.signals)
    filled = [np.nan_to_num(s[k], nan=float(np.median(x))) for s, k in zip(line.signals, shown, strict=True)]
    acts = tuple(line.law(s) - (s if line.is_whole else 0.0) for s in filled)
    name, unit, value, value_unit = _words(line)
    return MissingLaw(
        effect=line.effect.name, signal=name, unit=unit, value=value, value_unit=value_unit, is_whole=line.is_whole,
        branches=(branch,), acts=acts, rows=shown,
    )  # fmt: skip


def _line_of(bench: EquationBench, outcome: Outcome, number: int) -> _Line | None:
    """Return an effect with its signal at every row; nothing where it is no law over one signal."""
    effect, model = outcome.effects[number], bench.model
    form = form_of(effect, model)
    if form.acts not in ("force", "input") or form.remembers(effect.parameters):
        return None
    asks = names_in(parse(text_of(form, effect))) & {"V", "X", "value", "t", "column"}
    if asks not in ({"V"}, {"X"}, {"value"}):
        return None
    over = asks.pop()
    tree = Name(where_of(effect) or model.columns[0]) if over == "value" else local_names(model, effect)[over]
    if tree is None:
        return None
    compiled, signals = compile_with(model, outcome.effects, [to_text(tree)]), []
    for r, w in zip(bench.recordings, outcome.fitted.windows, strict=True):
        run = simulate(
            compiled, outcome.fitted.parameters, drive_of(model, r), w.states, starts=w.starts, stops=w.stops
        )  # fmt: skip
        signals.append(run.outputs[:, 1])
    return _Line(bench=bench, outcome=outcome, number=number, over=over, signals=tuple(signals))


def _words(line: _Line) -> tuple[str, str, str, str]:
    """Return the signal with its unit, and what the law gives with its unit."""
    effect, model = line.effect, line.bench.model
    units = units_at(model, effect, model.output_unit)
    if line.is_whole:
        return where_of(effect) or model.columns[0], units["u"], "command that acts", units["u"]
    tree = local_names(model, effect)[line.over]
    name = "" if tree is None else to_text(tree)
    value = f"change of d {effect.state}/dt" if effect.state else f"{effect.port}"
    return name, units["v" if line.over == "V" else "y"], value, units["f"]


def _band(line: _Line, x: FloatArray) -> FloatArray:
    """Return the law's 1-sigma by the effect's own numbers."""
    fitted, prefix = line.outcome.fitted, prefix_of(line.effect, line.number)
    names = [p.name for p in fitted.compiled.parameters]
    own = [i for i, name in enumerate(names) if name.startswith(prefix) and fitted.compiled.parameters[i].spread > 0.0]
    if not own:
        return np.zeros(x.size)
    J = fitted.jacobian
    covariance = np.linalg.inv(J.T @ J + np.eye(J.shape[1]))[np.ix_(own, own)]
    slopes, columns = np.abs(slopes_of(fitted.compiled, fitted.z)), []
    for k, i in enumerate(own):
        step = NUDGE * float(np.sqrt(covariance[k, k])) or NUDGE
        both = []
        for sign in (1.0, -1.0):
            moved = {names[i]: (float(fitted.parameters[i] + sign * step * slopes[i]), 0.0)}
            both.append(line.law(x, with_values(line.outcome.effects, moved)[line.number]))
        columns.append((both[0] - both[1]) / (2.0 * step))
    D = np.column_stack(columns)
    return np.asarray(np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", D, covariance, D), 0.0)))


def _bins(
    line: _Line, counts: list[BoolArray], grid: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """Return mean signal, value, 1-sigma and rows of every bin that tells something."""
    law = line.law(grid)
    size = float(np.ptp(law)) or float(np.max(np.abs(law))) or 1.0
    told: tuple[FloatArray, ...] = (np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
    for bins in BINS:
        edges = _edges(np.concatenate([s[ok] for s, ok in zip(line.signals, counts, strict=True)]), grid, bins)
        members = [[(s >= a) & (s < b) for s in line.signals] for a, b in pairwise(edges)]
        rows = np.array([sum(int((m & ok).sum()) for m, ok in zip(one, counts, strict=True)) for one in members])
        members = [one for one, n in zip(members, rows, strict=True) if n >= LEAST_ROWS]
        rows = rows[rows >= LEAST_ROWS]
        traced = _traced_back(line, members, SMALL * size) if members else None
        if traced is None:
            continue
        deviation, error = traced
        means = [np.concatenate([s[m & ok] for s, m, ok in zip(line.signals, one, counts, strict=True)]).mean()
                 for one in members]  # fmt: skip
        at, tells = np.array(means), error < WIDEST * size
        if np.count_nonzero(tells) > told[0].size:
            told = (at[tells], (line.law(at) + deviation)[tells], error[tells], rows[tells])
        if np.all(error < 0.25 * size):
            break
    return told[0], told[1], told[2], told[3].astype(np.int64)


def _edges(x: FloatArray, grid: FloatArray, bins: int) -> FloatArray:
    """Return edges of bins: half way between equal rows and equal widths; one at 0 where the signal changes sign."""
    shares = np.linspace(0.0, 1.0, bins + 1)
    inside = x[(x >= grid[0]) & (x <= grid[-1])]
    edges = 0.5 * (np.quantile(inside, shares) + grid[0] + (grid[-1] - grid[0]) * shares)
    if edges.size > 2 and edges[0] < 0.0 < edges[-1]:
        edges[1 + int(np.argmin(np.abs(edges[1:-1])))] = 0.0
    return np.unique(edges)


def _traced_back(
    line: _Line, members: list[list[BoolArray]], size: float
) -> tuple[FloatArray, FloatArray] | None:  # fmt: skip
    """Return how much of each bin's rows, added where the effect acts, explains the residual best, and its 1-sigma."""
    outcome, bench = line.outcome, line.bench
    columns = []
    for one in members:
        changed = _simulated(line, one, size)
        if changed is None:
            return None
        columns.append(bench.without_starts(outcome, changed) / size)
    noise = noise_of(bench, outcome)
    rho = noise.ar[0] if noise.ar else 0.0
    lengths = [int(np.isfinite(r.y).sum()) for r in bench.recordings]

    def whitened(v: FloatArray) -> FloatArray:
        parts = np.split(v, np.cumsum(lengths)[:-1])
        return np.concatenate([p[1:] - rho * p[:-1] for p in parts])

    X = np.column_stack([whitened(c) for c in columns])
    e = whitened(bench.without_starts(outcome, outcome.residual))
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv((X / scale).T @ (X / scale), rcond=1e-9, hermitian=True)
    beta = inverse @ ((X / scale).T @ e)
    left = e - (X / scale) @ beta
    variance = float(left @ left) / max(e.size - beta.size, 1)
    return beta / scale, np.sqrt(np.maximum(np.diag(inverse), 0.0) * variance) / scale


def _simulated(line: _Line, rows: list[BoolArray], size: float) -> FloatArray | None:
    """Return how readings at the rows that count change where a size is added at some rows of the effect's place."""
    model, outcome = line.bench.model, line.outcome
    marked = replace(model, inputs=(*model.inputs, InputColumn(column=MARK)))
    added = _added(line, Call("*", (Number(size), Name(MARK))))
    compiled = compile_with(marked, outcome.effects, further=[added])
    p = compiled.parameter_vector
    known = dict(zip([q.name for q in outcome.fitted.compiled.parameters], outcome.fitted.parameters, strict=True))
    p = np.array([known.get(q.name, value) for q, value in zip(compiled.parameters, p, strict=True)])
    found = []
    runs = zip(line.bench.recordings, rows, outcome.fitted.windows, outcome.fitted.simulated, strict=True)
    for r, mark, w, before in runs:
        drive = drive_of(marked, replace(r, extra={**r.extra, MARK: mark.astype(np.float64)}))
        y = simulate(compiled, p, drive, w.states, starts=w.starts, stops=w.stops).y
        found.append((y - before)[np.isfinite(r.y)])
    change = np.concatenate(found)
    return change if np.all(np.isfinite(change)) else None


def _added(line: _Line, tree: Expression) -> Extension:
    """Return an expression added where an effect acts."""
    effect, column = line.effect, where_of(line.effect) or line.bench.model.columns[0]
    if line.is_whole:
        return Extension(name=MARK, input={column: Call("+", (Name("value"), tree))})
    if effect.port:
        return Extension(name=MARK, port={effect.port: tree})
    return Extension(name=MARK, derivative={effect.state: tree})
