"""A fit to the rows of some windows, told for all rows of the recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit


def spread_out(result: Fit, data: Data) -> tuple[Fit, Data]:
    """Return a fit and its data with all rows of the recordings; as they are where all rows are there.

    Parameters
    ----------
    result : Fit
        A fit to the data.
    data : Data
        Perhaps a part of the recordings' rows, see :meth:`Data.only`.

    Returns
    -------
    fit, data
        Residuals and derivatives are zero at the rows added, simulated signals no numbers.
    """
    if data.whole is None:
        return result, data
    lengths = [len(r) for r in data.driving]
    edges = np.cumsum([0, *lengths])
    at = np.concatenate([edge + k for edge, k in zip(edges, data.kept, strict=False)])

    def each(values: tuple[FloatArray, ...], empty: float) -> tuple[FloatArray, ...]:
        found = tuple(np.full((n, *v.shape[1:]), empty) for n, v in zip(lengths, values, strict=True))
        for new, k, v in zip(found, data.kept, values, strict=True):
            new[k] = v
        return found

    def joint(values: FloatArray) -> FloatArray:
        found = np.zeros((edges[-1], *values.shape[1:]))
        found[at] = values
        return found

    windows = tuple((int(at[a]), int(at[b - 1]) + 1) for a, b in result.windows)
    spread = replace(
        result,
        residuals=each(result.residuals, 0.0),
        whitened=each(result.whitened, 0.0),
        signals=each(result.signals, np.nan),
        explained=joint(result.explained),
        jacobian=(joint(result.jacobian[0]), joint(result.jacobian[1])),
        windows=windows,
    )
    return spread, data.spread_out()
