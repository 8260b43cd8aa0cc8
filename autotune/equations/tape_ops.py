"""The tape's operations in compiled code: values, and tangents along a direction."""

from __future__ import annotations

import math

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.equations.in_place import in_place
from autotune.equations.opcodes import (
    ACOS,
    ADD,
    ASIN,
    ATAN,
    ATAN2,
    CHOOSE,
    COS,
    COSH,
    DIV,
    EXP,
    LOG,
    MUL,
    NEG,
    POW,
    SELECT,
    SIN,
    SINH,
    SQRT,
    SQUARE,
    SUB,
    TAN,
    TANH,
)  # fmt: skip


@in_place
def evaluate(code: IntArray, first: int, last: int, r: FloatArray, extended: bool) -> None:
    """Run operations on the registers; what is undefined becomes NaN.

    What is undefined becomes NaN; ``extended``, roots and logarithms go on beyond their domain, so that a step over
    the crossing of ``sqrt(max(h, 0))``, whose mode is held, can be tried and cut there.

    Parameters
    ----------
    code : (K, 5) array of int
        Operations.
    first, last : int
        The first, and the one after the last.
    r : array
        The registers, changed in place.
    extended : bool
        Whether roots and logarithms go on beyond their domain, so that a step over the crossing of ``sqrt(max(h,
        0))``, whose mode is held, can be tried and cut there.
    """
    for k in range(first, last):
        o = code[k, 0]
        a = r[code[k, 2]]
        b = r[code[k, 3]]
        v = np.nan
        if o == ADD:
            v = a + b
        elif o == SUB:
            v = a - b
        elif o == MUL:
            v = a * b
        elif o == DIV:
            v = a / b
        elif o == NEG:
            v = -a
        elif o == SQUARE:
            v = a * a
        elif o == SELECT:
            mode = r[code[k, 4]]
            if mode == 1.0:
                v = a
            elif mode == -1.0:
                v = b
            else:
                v = 0.5 * ((1.0 + mode) * a + (1.0 - mode) * b)
        elif o == CHOOSE:
            v = a if r[code[k, 4]] >= 0.0 else b
        elif o == POW:
            if a >= 0.0 or b == np.floor(b):
                v = a**b
            elif extended:
                v = -((-a) ** b)
        elif o == EXP:
            v = math.exp(min(a, 709.0))
        elif o == LOG:
            v = np.log(max(a, 1e-300)) if extended else np.log(a)
        elif o == SQRT:
            v = -np.sqrt(-a) if extended and a < 0.0 else np.sqrt(a)
        elif o == SIN:
            v = math.sin(a)
        elif o == COS:
            v = math.cos(a)
        elif o == TAN:
            v = math.tan(a)
        elif o == ASIN:
            v = np.arcsin(a)
        elif o == ACOS:
            v = np.arccos(a)
        elif o == ATAN:
            v = math.atan(a)
        elif o == ATAN2:
            v = math.atan2(a, b)
        elif o == SINH:
            v = np.sinh(a)
        elif o == COSH:
            v = np.cosh(a)
        elif o == TANH:
            v = math.tanh(a)
        r[code[k, 1]] = v


@in_place
def tangents(code: IntArray, first: int, last: int, r: FloatArray, d: FloatArray) -> None:
    """Carry a direction of the registers through operations whose values they hold; modes stay fixed.

    Parameters
    ----------
    code : (K, 5) array of int
        Operations.
    first, last : int
        The first, and the one after the last.
    r : array
        The registers.
    d : array
        The direction, of r's length, changed in place.
    """
    for k in range(first, last):
        o = code[k, 0]
        i, j = code[k, 2], code[k, 3]
        a, b, v = r[i], r[j], r[code[k, 1]]
        da, db = d[i], d[j]
        w = 0.0
        if o == ADD:
            w = da + db
        elif o == SUB:
            w = da - db
        elif o == MUL:
            w = da * b + a * db
        elif o == DIV:
            w = (da - v * db) / b
        elif o == NEG:
            w = -da
        elif o == SQUARE:
            w = 2.0 * a * da
        elif o == SELECT:
            mode = r[code[k, 4]]
            w = 0.5 * ((1.0 + mode) * da + (1.0 - mode) * db)
        elif o == CHOOSE:
            w = da if r[code[k, 4]] >= 0.0 else db
        elif da == 0.0 and (db == 0.0 or (o != POW and o != ATAN2)):
            w = 0.0
        elif o == POW:
            w = b * a ** (b - 1.0) * da + (v * np.log(a) * db if db != 0.0 else 0.0)
        elif o == EXP:
            w = v * da
        elif o == LOG:
            w = da / a
        elif o == SQRT:
            w = 0.5 * da / abs(v)
        elif o == SIN:
            w = math.cos(a) * da
        elif o == COS:
            w = -math.sin(a) * da
        elif o == TAN:
            w = (1.0 + v * v) * da
        elif o == ASIN:
            w = da / np.sqrt(1.0 - a * a)
        elif o == ACOS:
            w = -da / np.sqrt(1.0 - a * a)
        elif o == ATAN:
            w = da / (1.0 + a * a)
        elif o == ATAN2:
            w = (b * da - a * db) / (a * a + b * b)
        elif o == SINH:
            w = np.cosh(a) * da
        elif o == COSH:
            w = np.sinh(a) * da
        elif o == TANH:
            w = (1.0 - v * v) * da
        d[code[k, 1]] = w


@in_place
def solve(A: FloatArray, b: FloatArray, n: int) -> None:
    """Solve the leading n by n system in place by elimination with row pivots.

    Parameters
    ----------
    A : (n or more, n or more) array
        The matrix, changed in place.
    b : (n or more,) array
        Right-hand side; becomes the solution.
    n : int
        Size of the system.
    """
    for i in range(n):
        p = i
        for row in range(i + 1, n):
            if abs(A[row, i]) > abs(A[p, i]):
                p = row
        if A[p, i] == 0.0:
            A[p, i] = 1e-300
        if p != i:
            for column in range(n):
                A[i, column], A[p, column] = A[p, column], A[i, column]
            b[i], b[p] = b[p], b[i]
        for row in range(i + 1, n):
            factor = A[row, i] / A[i, i]
            if factor != 0.0:
                for column in range(i, n):
                    A[row, column] -= factor * A[i, column]
                b[row] -= factor * b[i]
    for i in range(n - 1, -1, -1):
        for column in range(i + 1, n):
            b[i] -= A[i, column] * b[column]
        b[i] /= A[i, i]
