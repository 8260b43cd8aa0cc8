"""An effect of equations as a law over its signal, with what the data say in bins around it.

As for a chain: what the extended model leaves of the readings is traced back to where the effect acts, bin by bin of
its signal, and added to the curve (component plus residual); the other numbers are held. What a bin adds is simulated:
an indicator of its rows drives the place of the effect as a measured input would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.equations.bench import Outcome
from autotune.diagnosis.equations.equation_bench import EquationBench
from autotune.diagnosis.equations.scores import noise_of
from autotune.diagnosis.equations.sizes import units_at
from autotune.diagnosis.evidence.missing_law import LawLine
from autotune.effects import KINDS
from autotune.equations.effects import (
    at_state,
    compile_with,
    form_of,
    local_names,
    prefix_of,
    text_of,
    where_of,
    with_values,
)
from autotune.equations.expressions import Call, Expression, Name, Number, names_in, parse, substitute, to_text
from autotune.equations.model import EquationModel, Extension, InputColumn, State
from autotune.equations.parameter_scales import values_of
from autotune.equations.sensitivity import run_windows
from autotune.equations.simulate import compile_model, derivatives, drive_of
from autotune.models import Effect

#: Name of the column that marks a bin's rows, and its size in sizes of the law: small, for the first order is asked.
MARK, SMALL = "rows_of_a_bin", 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationLine(LawLine):
    """A fitted effect whose text is a law over one signal.

    Attributes
    ----------
    bench : EquationBench
        The model on its recordings.
    outcome : Outcome
        The fit.
    number : int
        The effect's position among those of the fit.
    over : {"V", "X", "value"}
        What the text calls the signal.
    signals : tuple of (N,) array
        The signal per recording; NaN outside the windows.
    """

    bench: EquationBench
    outcome: Outcome
    number: int
    over: str
    signals: tuple[FloatArray, ...]

    @property
    def effect(self) -> Effect:
        """The effect with its fitted values."""
        return self.outcome.effects[self.number]

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name

    @property
    def words(self) -> tuple[str, str, str, str]:
        """The signal that it is drawn over with its unit, and what it gives with its unit."""
        effect, model = self.effect, self.bench.model
        units = units_at(model, effect, model.output_unit)
        if self.is_whole:
            return where_of(effect) or model.columns[0], units["u"], "command that acts", units["u"]
        tree = local_names(model, effect)[self.over]
        name = "" if tree is None else to_text(tree)
        value = f"change of d {effect.state}/dt" if effect.state else f"{effect.port}"
        return name, units["v" if self.over == "V" else "y"], value, units["f"]

    @property
    def is_whole(self) -> bool:
        """Whether it puts something in the place of its signal, and adds nothing to it."""
        return self.over == "value"

    def values(self) -> list[FloatArray]:
        """Return the signal, (N,) per recording; its median where nothing was simulated."""
        middle = float(np.nanmedian(np.concatenate(self.signals)))
        return [np.nan_to_num(s, nan=middle) for s in self.signals]

    def counts(self) -> BoolArray:
        """Return the rows, all recordings one after the other, that were simulated and count."""
        each = zip(self.bench.recordings, self.signals, strict=True)
        return np.concatenate([np.isfinite(r.y) & np.isfinite(s) for r, s in each])

    def numbers(self) -> tuple[FloatArray, list[int], FloatArray]:
        """Return the fit's numbers, which of them are the effect's own, and the covariance of these."""
        fitted, prefix, J = self.outcome.fitted, prefix_of(self.effect, self.number), self.outcome.fitted.jacobian
        free = enumerate(fitted.compiled.parameters)
        own = [i for i, p in free if p.name.startswith(prefix) and p.spread > 0.0]
        covariance = np.asarray(np.linalg.inv(J.T @ J + np.eye(J.shape[1])))
        return fitted.z, own, covariance[np.ix_(own, own)]

    def law(self, x: FloatArray, theta: FloatArray, number: int = 0) -> FloatArray:
        """Return what the effect gives at values of its signal, (K,), at numbers of the fit."""
        compiled, model = self.outcome.fitted.compiled, self.bench.model
        named = zip(compiled.parameters, values_of(compiled, theta), strict=True)
        there = with_values(self.outcome.effects, {p.name: (float(v), 0.0) for p, v in named})
        effect, form = there[self.number], form_of(self.effect, model)

        def bound(name: str) -> Expression | None:
            if name == self.over:
                return Name("x")
            if name in ("pi", "t"):
                return None
            q = KINDS[effect.name].quantity(name)
            neutral = form.defaults.get(name, None if q is None else q.neutral)
            return Number(float(effect.values.get(name, 0.0 if neutral is None else neutral)))

        shell = EquationModel(
            name="law", inputs=(InputColumn(column="x"),), parameters=(),
            output=substitute(parse(text_of(form, effect)), bound),
            states=(State(name="nothing", derivative=Name("nothing"), start=0.0),),
        )  # fmt: skip
        compiled = compile_model(shell)
        points = np.atleast_2d(x).T
        return np.asarray(derivatives(compiled, compiled.parameter_vector, np.zeros((x.size, 1)), points)[1][:, 0])

    def traced_back(self, bins: Sequence[BoolArray]) -> tuple[FloatArray, FloatArray]:
        """Return how much, added where it acts at the rows of each bin, explains the residual best, and its 1-sigma."""
        bench, outcome = self.bench, self.outcome
        law = self.law(np.concatenate(self.values())[self.counts()], outcome.fitted.z)
        size = SMALL * (float(np.ptp(law)) or float(np.max(np.abs(law))) or 1.0)
        noise = noise_of(bench, outcome)
        rho = noise.ar[0] if noise.ar else 0.0
        lengths = [int(np.isfinite(r.y).sum()) for r in bench.recordings]

        def whitened(v: FloatArray) -> FloatArray:
            parts = np.split(bench.without_starts(outcome, v), np.cumsum(lengths)[:-1])
            return np.concatenate([p[1:] - rho * p[:-1] for p in parts])

        changes = [_simulated(self, rows, size) for rows in bins]
        if not all(np.all(np.isfinite(change)) for change in changes):  # it runs away: no bin tells anything
            return np.zeros(len(bins)), np.full(len(bins), np.inf)
        X, e = np.column_stack([whitened(change) / size for change in changes]), whitened(outcome.residual)
        scale = np.linalg.norm(X, axis=0)
        scale[scale == 0.0] = 1.0
        inverse = np.linalg.pinv((X / scale).T @ (X / scale), rcond=1e-9, hermitian=True)
        beta = inverse @ ((X / scale).T @ e)
        left = e - (X / scale) @ beta
        variance = float(left @ left) / max(e.size - beta.size, 1)
        return beta / scale, np.sqrt(np.maximum(np.diag(inverse), 0.0) * variance) / scale


def line_in_equations(bench: EquationBench, outcome: Outcome, number: int) -> EquationLine | None:
    """Return an effect with its signal at every row.

    Parameters
    ----------
    bench, outcome, number
        As of :class:`EquationLine`.

    Returns
    -------
    EquationLine or None
        None for an effect that has a memory, or goes with the time or with several signals.
    """
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
        signals.append(run_windows(compiled, outcome.fitted.parameters, drive_of(model, r), w).outputs[:, 1])
    return EquationLine(bench=bench, outcome=outcome, number=number, over=over, signals=tuple(signals))


def _simulated(line: EquationLine, rows: BoolArray, size: float) -> FloatArray:
    """Return how readings at the rows that count change where a size is added at some rows of the effect's place."""
    model, outcome = line.bench.model, line.outcome
    marked = replace(model, inputs=(*model.inputs, InputColumn(column=MARK)))
    added = _added(line, Call("*", (Number(size), Name(MARK))))
    compiled = compile_with(marked, outcome.effects, further=[added])
    p = compiled.parameter_vector
    known = dict(zip([q.name for q in outcome.fitted.compiled.parameters], outcome.fitted.parameters, strict=True))
    p = np.array([known.get(q.name, value) for q, value in zip(compiled.parameters, p, strict=True)])
    found = []
    marks = np.split(rows, np.cumsum([len(r) for r in line.bench.recordings])[:-1])
    runs = zip(line.bench.recordings, marks, outcome.fitted.windows, outcome.fitted.simulated, strict=True)
    for r, mark, w, before in runs:
        drive = drive_of(marked, replace(r, extra={**r.extra, MARK: mark.astype(np.float64)}))
        y = run_windows(compiled, p, drive, w).y
        found.append((y - before)[np.isfinite(r.y)])
    return np.concatenate(found)


def _added(line: EquationLine, tree: Expression) -> Extension:
    """Return an expression added where an effect acts."""
    effect, column = line.effect, where_of(line.effect) or line.bench.model.columns[0]
    if line.is_whole:
        return Extension(name=MARK, input={column: Call("+", (Name("value"), tree))})
    if effect.port:
        return Extension(name=MARK, port={effect.port: tree})
    return Extension(name=MARK, derivative=at_state(line.bench.model, effect.state, tree))
