"""Recorded columns that a model does not have, and that may drive its plant all the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.expressions import FUNCTIONS, RESERVED
from autotune.equations.model import EquationModel
from autotune.recording import Recording

#: Columns that mean something else.
TAKEN = frozenset({"t", "u", "y", "r", "u_applied", *FUNCTIONS, *RESERVED})
#: Correlation with command or reading from which on a column is that signal again.
SAME = 0.99
#: Share of its largest value by which a column moves at least.
STILL = 1e-9


def further_columns(model: EquationModel, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the columns that all recordings have, that move, and that are no signal of the model.

    Parameters
    ----------
    model : EquationModel
        Its names are taken: a column that is called like a state is a reading of that state.
    recordings : sequence of Recording
        What was measured.

    Returns
    -------
    tuple of str
        Names that an expression can hold, values that are all numbers; command and reading in other units left out.
    """
    names = {*TAKEN, *model.columns, *model.state_names, *model.parameter_names, *(name for name, _ in model.defines),
             *(port.name for port in model.ports)}  # fmt: skip
    found = []
    for name in recordings[0].extra:
        if name in names or not name.isidentifier() or not all(name in r.extra for r in recordings):
            continue
        d, u, y = (np.concatenate([r[key] for r in recordings]) for key in (name, model.columns[0], "y"))
        good = np.isfinite(y)
        moves = bool(np.all(np.isfinite(d))) and float(np.ptp(d)) > STILL * float(np.max(np.abs(d)))
        if moves and not any(_is_same(d[good], x[good]) for x in (u, y)):
            found.append(name)
    return tuple(found)


def _is_same(d: FloatArray, x: FloatArray) -> bool:
    """Whether two signals differ by their units alone."""
    d, x = d - np.mean(d), x - np.mean(x)
    return abs(float(d @ x)) > SAME * float(np.linalg.norm(d)) * float(np.linalg.norm(x)) > 0.0
