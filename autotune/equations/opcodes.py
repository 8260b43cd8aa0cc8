"""Numbers of the operations that the compiled simulation knows; shared by the translator and the kernel."""

from __future__ import annotations

ADD, SUB, MUL, DIV, NEG, SQUARE = 0, 1, 2, 3, 4, 5
SELECT, CHOOSE = 6, 7  # by the mode of a located switch; by the sign of a register, at once
POW, EXP, LOG, SQRT = 8, 9, 10, 11
SIN, COS, TAN, ASIN, ACOS, ATAN, ATAN2 = 12, 13, 14, 15, 16, 17, 18
SINH, COSH, TANH = 19, 20, 21

UNARY = {
    "neg": NEG, "exp": EXP, "log": LOG, "sqrt": SQRT, "sin": SIN, "cos": COS, "tan": TAN, "asin": ASIN, "acos": ACOS,
    "atan": ATAN, "sinh": SINH, "cosh": COSH, "tanh": TANH,
}  # fmt: skip
BINARY = {"+": ADD, "-": SUB, "*": MUL, "/": DIV, "^": POW, "atan2": ATAN2}
