"""What a column's tag and its values say where its words do not: letters of ISA-5.1, and which signal keeps to r."""

from __future__ import annotations

import re

import numpy as np

from autotune.arrays import FloatArray

#: letters of ISA-5.1 before a loop's number: what is measured or moved, then what the instrument does
_TAG = re.compile(r"(?<![A-Za-z])([A-Z]{2,4})[-_ ]?\d{1,6}[A-Z]?(?![A-Za-z0-9])")
_MEASURED = frozenset("ADFLPSTWXQ")
_TRANSMITS, _MOVES = frozenset("TEI"), frozenset("VZ")
#: a column follows the set-point if it is nearer to it than the other by this factor
_NEARER = 3.0


def instrument(name: str) -> str:
    """Return the role that an instrument's tag gives, ``u`` or ``y``; empty where it gives none.

    A transmitter, element or indicator (PT101, TE-7, FI3) measures, a final element (YV101, FCV-2) moves. PV with a
    number is either, a pressure valve or a process value, and TIC101 is the loop itself.
    """
    found = _TAG.search(name)
    if found is None:
        return ""
    letters = found.group(1)
    if letters in ("PV", "SP", "OP", "MV", "CV"):
        return ""
    if letters[-1] in _MOVES:
        return "u"
    return "y" if letters[0] in _MEASURED and letters[-1] in _TRANSMITS else ""


def follower(r: FloatArray, first: FloatArray, second: FloatArray) -> int | None:
    """Return which of two signals keeps to the set-point, 0 or 1; None where neither does so clearly more.

    What equals the set-point in every row is a copy of it, and no measurement.

    Parameters
    ----------
    r, first, second : (N,) array
        Set-point and two signals, NaN where missing.
    """
    distances = []
    for values in (first, second):
        apart = np.abs(values - r)
        known = apart[np.isfinite(apart)]
        if not np.any(known > 0.0):
            return None
        distances.append(float(np.median(known)))
    near, far = min(distances), max(distances)
    if not far > _NEARER * near:
        return None
    return distances.index(near)
