"""The law of :class:`autotune.design.law.PILaw` as C and as Structured Text, statement for statement."""

from __future__ import annotations

import math

from autotune.design.law import PILaw

_NO_LIMIT = 1e30  # stands for infinity where the language has no literal for it

_C = """\
/* {kind} law: K = {K:.9g}, Ti = {Ti:.9g} s, Td = {Td:.9g} s, Tf = {Tf:.9g} s, sampled every {Ts:.9g} s.
 * Call control_init once with the command the actuator holds: bumpless. Then call control_step at every sample.
 * The command stays within {u_min:.9g} .. {u_max:.9g} and moves by at most {move:.9g} per sample; anti-windup by
 * back-calculation. */

typedef struct {{
    double integral;
    double y_filtered;
    double u;
}} control_state;

static double control_limit(double low, double value, double high)
{{
    if (value < low)
        return low;
    return value > high ? high : value;
}}

void control_init(control_state *state, double u, double r, double y)
{{
    state->u = control_limit({u_min!r}, u, {u_max!r});
    state->y_filtered = y;
    state->integral = state->u - {K!r} * ({b!r} * r - y) - {slope!r} * (r - y);
}}

double control_step(control_state *state, double r, double y)
{{
    const double y_f = state->y_filtered + {alpha!r} * (y - state->y_filtered);
    const double integral = state->integral + {slope!r} * (r - y_f);
    const double v = {K!r} * ({b!r} * r - y_f) + integral - {D!r} * (y_f - state->y_filtered);
    double u = control_limit(state->u - {move!r}, v, state->u + {move!r});
    u = control_limit({u_min!r}, u, {u_max!r});
    state->integral = integral + {tracking!r} * (u - v);
    state->y_filtered = y_f;
    state->u = u;
    return u;
}}
"""

_ST = """\
(* {kind} law: K = {K:.9g}, Ti = {Ti:.9g} s, Td = {Td:.9g} s, Tf = {Tf:.9g} s; call it every {Ts:.9g} s.
   While HOLD is TRUE the output follows U_HELD and takes over from it without a bump when HOLD falls. *)
FUNCTION_BLOCK CONTROL_LAW
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


def c_source(law: PILaw) -> str:
    """Return C99 source with ``control_init`` and ``control_step``; no library, no allocation, no globals."""
    return _C.format(**_constants(law))


def structured_text(law: PILaw) -> str:
    """Return an IEC 61131-3 function block ``CONTROL_LAW`` in Structured Text, standard functions only."""
    constants = _constants(law)
    shown = {"K", "Ti", "Td", "Tf", "Ts"}
    literal = {key: _literal(value) for key, value in constants.items() if isinstance(value, float)}
    body, comment = _ST.split("*)", 1)[1], _ST.split("*)", 1)[0]
    head = comment.format(**{key: constants[key] for key in (*shown, "kind")})
    return head + "*)" + body.format(**literal)


def _literal(value: float) -> str:
    """Return an LREAL literal; a negative one in brackets, since ST has no sign after an operator."""
    text = repr(value)
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = (mantissa if "." in mantissa else mantissa + ".0") + "E" + str(int(exponent))
    return f"({text})" if value < 0.0 else text


def _constants(law: PILaw) -> dict[str, str | float]:
    c, T_s = law.controller, law.sample_time_s
    return {
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
