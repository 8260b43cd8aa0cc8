"""Tables 1 and 2 of Ollivier, Moutaouakil and Sadik 2007: estimates over many noisy recordings of their examples.

The noise is drawn anew, so that means and standard deviations are to be compared, not single numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autotune.arrays import FloatArray
from autotune.report.page import Page, Section, Table

#: Name, true value, and the paper's mean and standard deviation, of Example 2 at noise 5.
TABLE_1 = (
    ("a_1", -1.2, "-1.17", "0.084"),
    ("a_0", -0.35, "-0.34", "0.029"),
    ("b", 2.0, "1.94", "0.17"),
    ("h [s]", 4.0, "3.97", "0.065"),
)
#: The same of Example 3 at noise .1.
TABLE_2 = (
    ("a", 2.7, "2.70", "0.043"),
    ("b", 1.5, "1.50", "0.025"),
    ("h_1 [s]", 2.0, "1.99", "0.01"),
    ("h_2 [s]", 4.0, "3.99", "0.017"),
)
_HEADER = ("", "true", "mean, paper", "mean, here", "sd, paper", "sd, here")


def delay_page(one_delay: FloatArray, two_delays: FloatArray) -> Page:
    """Return the page with both tables.

    Parameters
    ----------
    one_delay, two_delays : (sets, 4) array
        Estimates by the paper's methods, in the order of TABLE_1 and TABLE_2.
    """
    sets = len(one_delay)
    return Page(
        title="Delays by modulating functions, the examples of 2007",
        verdict=f"{sets} recordings of each example: delay {np.mean(one_delay[:, 3]):.3f} s for 4 s, delays"
        f" {np.mean(two_delays[:, 2]):.3f} s and {np.mean(two_delays[:, 3]):.3f} s for 2 s and 4 s.",
        tone="good",
        summary=("Least squares with noise in its regressors is biased towards zero, in the paper as here.",),
        sections=(
            _section("Table 1: Example 2 at noise 5", TABLE_1, one_delay),
            _section("Table 2: Example 3, two delays, at noise 0.1", TABLE_2, two_delays),
        ),
    )


def _section(title: str, printed: Sequence[tuple[str, float, str, str]], found: FloatArray) -> Section:
    rows = tuple(
        (name, f"{true:g}", mean, f"{np.mean(values):.4g}", sd, f"{np.std(values, ddof=1):.2g}")
        for (name, true, mean, sd), values in zip(printed, found.T, strict=True)
    )
    return Section(title=title, tables=(Table(header=_HEADER, rows=rows),))
