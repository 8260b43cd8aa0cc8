"""The law of :class:`autotune.design.law.PILaw` as C and as Structured Text, statement for statement."""

from __future__ import annotations

import math
import re

from autotune.design.law import PILaw
from autotune.errors import DesignError

_NO_LIMIT = 1e30  # stands for infinity where the language has no literal for it

_C = """\
/* {kind} law: K = {K:.9g}, Ti = {Ti:.9g} s, Td = {Td:.9g} s, Tf = {Tf:.9g} s, sampled every {Ts:.9g} s.
 * Call {name}_init once with the command the actuator holds: bumpless. Then call {name}_step at every sample.
 * The command stays within {u_min:.9g} .. {u_max:.9g} and moves by at most {move:.9g} per sample; anti-windup by
 * back-calculation. */

typedef struct {{
    {real} integral;
    {real} y_filtered;
    {real} u;
}} {name}_state;

static {real} {name}_limit({real} low, {real} value, {real} high)
{{
    if (value < low)
        return low;
    return value > high ? high : value;
}}

void {name}_init({name}_state *state, {real} u, {real} r, {real} y)
{{
    state->u = {name}_limit({u_min!r}{f}, u, {u_max!r}{f});
    state->y_filtered = y;
    state->integral = state->u - {K!r}{f} * ({b!r}{f} * r - y) - {slope!r}{f} * (r - y);
}}

{real} {name}_step({name}_state *state, {real} r, {real} y)
{{
    const {real} y_f = state->y_filtered + {alpha!r}{f} * (y - state->y_filtered);
    const {real} integral = state->integral + {slope!r}{f} * (r - y_f);
    const {real} v = {K!r}{f} * ({b!r}{f} * r - y_f) + integral - {D!r}{f} * (y_f - state->y_filtered);
    {real} u = {name}_limit(state->u - {move!r}{f}, v, state->u + {move!r}{f});
    u = {name}_limit({u_min!r}{f}, u, {u_max!r}{f});
    state->integral = integral + {tracking!r}{f} * (u - v);
    state->y_filtered = y_f;
    state->u = u;
    return u;
}}
"""

_ST = """\
(* {kind} law: K = {K:.9g}, Ti = {Ti:.9g} s, Td = {Td:.9g} s, Tf = {Tf:.9g} s; call it every {Ts:.9g} s.
   While HOLD is TRUE the output follows U_HELD and takes over from it without a bump when HOLD falls. *)
FUNCTION_BLOCK {name}
VAR_INPUT
    R : LREAL;
    Y : LREAL;
    HOLD : BOOL := TRUE;
    U_HELD : LREAL;
END_VAR
VAR_OUTPUT
    U : LREAL;
END_VAR
VAR
    I_PART : LREAL;
    Y_FILTERED : LREAL;
    Y_F : LREAL;
    V : LREAL;
END_VAR
IF HOLD THEN
    U := LIMIT({u_min}, U_HELD, {u_max});
    Y_FILTERED := Y;
    I_PART := U - {K} * ({b} * R - Y) - {slope} * (R - Y);
ELSE
    Y_F := Y_FILTERED + {alpha} * (Y - Y_FILTERED);
    I_PART := I_PART + {slope} * (R - Y_F);
    V := {K} * ({b} * R - Y_F) + I_PART - {D} * (Y_F - Y_FILTERED);
    U := LIMIT(U - {move}, V, U + {move});
    U := LIMIT({u_min}, U, {u_max});
    I_PART := I_PART + {tracking} * (U - V);
    Y_FILTERED := Y_F;
END_IF;
END_FUNCTION_BLOCK
"""


def c_source(law: PILaw, *, name: str = "control", single: bool = False) -> str:
    """Return C99 source with ``NAME_init`` and ``NAME_step``; no library, no allocation, no globals.

    Parameters
    ----------
    law : PILaw
        Gains, sample time, limits.
    name : str
        Prefix of the identifiers.
    single : bool
        ``float`` instead of ``double``, for processors without double precision.

    Raises
    ------
    DesignError
        A name that is no identifier.
    """
    constants = _constants(law, name)
    return _C.format(**constants, real="float" if single else "double", f="f" if single else "")


def structured_text(law: PILaw, *, name: str = "CONTROL_LAW") -> str:
    """Return an IEC 61131-3 function block in Structured Text, standard functions only.

    Parameters
    ----------
    law : PILaw
        Gains, sample time, limits.
    name : str
        Of the function block.

    Raises
    ------
    DesignError
        A name that is no identifier.
    """
    constants = _constants(law, name)
    shown = {"K", "Ti", "Td", "Tf", "Ts"}
    literal = {key: _literal(value) for key, value in constants.items() if isinstance(value, float)}
    body, comment = _ST.split("*)", 1)[1], _ST.split("*)", 1)[0]
    head = comment.format(**{key: constants[key] for key in (*shown, "kind")})
    return head + "*)" + body.format(**(literal | {"name": name}))


def _literal(value: float) -> str:
    """Return an LREAL literal; a negative one in brackets, since ST has no sign after an operator."""
    text = repr(value)
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = (mantissa if "." in mantissa else mantissa + ".0") + "E" + str(int(exponent))
    return f"({text})" if value < 0.0 else text


def _constants(law: PILaw, name: str) -> dict[str, str | float]:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise DesignError(f"{name!r} is no identifier", where="code generation", remedy="letters, digits, underscore")
    c, T_s = law.controller, law.sample_time_s
    return {
        "name": name,
        "kind": c.kind.upper(),
        "K": float(c.K),
        "Ti": float(c.Ti_s),
        "Td": float(c.Td_s),
        "Tf": float(c.Tf_s),
        "Ts": float(T_s),
        "b": float(c.setpoint_weight),
        "alpha": T_s / (c.Tf_s + T_s),
        "slope": 0.0 if math.isinf(c.Ti_s) else c.K * T_s / c.Ti_s,
        "D": c.K * c.Td_s / T_s,
        "u_min": max(float(law.u_min), -_NO_LIMIT),
        "u_max": min(float(law.u_max), _NO_LIMIT),
        "move": min(law.u_rate * T_s, _NO_LIMIT),
        "tracking": law.tracking_gain,
    }
