"""Gains in the forms of common controllers, and back.

Each form is what its maker's manual calls by these names:

- ``isa``: K (1 + 1/(T_I s) + T_d s) on a measurement filtered with T_f, as everywhere in this project;
- ``parallel``: Kp + Ki/s + Kd s, measurement filter T_f;
- ``series``: K' (1 + 1/(T_I' s)) (1 + T_d' s), measurement filter T_f; exists for T_I >= 4 T_d;
- ``velocity``: du[k] = q0 e[k] + q1 e[k-1] + q2 e[k-2], backward differences, measurement filter T_f;
- ``siemens``: PID_Compact (S7-1200/1500): Gain ((b w - x) + 1/(Ti s)(w - x) + Td s/(TdFiltRatio Td s + 1)(c w - x));
- ``rockwell-dependent``, ``rockwell-independent``: PIDE (Logix): gains on percent of span, times in minutes;
- ``schneider-mixed``, ``schneider-parallel``: PIDFF (Control Expert): derivative Td s/(1 + Td/Kd s); in the parallel
  structure the integral and derivative parts carry the ratio of the output's span to the measurement's.

Makers take positive gains and an action: ``reverse_acting`` is 1 where a rising measurement lowers the output (K > 0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

from autotune.controller import PIDController
from autotune.errors import DesignError

Form: TypeAlias = Literal[
    "isa",
    "parallel",
    "series",
    "velocity",
    "siemens",
    "rockwell-dependent",
    "rockwell-independent",
    "schneider-mixed",
    "schneider-parallel",
]
FORMS: tuple[Form, ...] = get_args(Form)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What to type into a controller.

    Attributes
    ----------
    form : str
        One of ``FORMS``.
    values : mapping of str to float
        Settings by the maker's names; times in the maker's unit, which the key says where it is not seconds.
    u_span, y_span : float
        Engineering span of output and measurement, used by forms that work in percent or with span ratios.
    sample_time_s : float
        Of the velocity form [s]; 0 elsewhere.
    """

    form: Form
    values: Mapping[str, float]
    u_span: float = 1.0
    y_span: float = 1.0
    sample_time_s: float = 0.0


def to_form(
    controller: PIDController, form: Form, *, u_span: float = 1.0, y_span: float = 1.0, sample_time_s: float = 0.0
) -> Settings:
    """Return the settings with which the form has exactly the controller's feedback C(s).

    Parameters
    ----------
    controller : PIDController
        K with its sign.
    form : str
        One of ``FORMS``.
    u_span, y_span : float
        Engineering spans, for the Rockwell and Schneider forms.
    sample_time_s : float
        For the velocity form [s].

    Raises
    ------
    DesignError
        The form cannot express the controller exactly; the message says why.
    """
    c = replace(controller, K=abs(controller.K))
    if not u_span > 0.0 or not y_span > 0.0:
        raise DesignError("spans must be positive", where=form)
    action = {"reverse_acting": 1.0 if controller.K >= 0.0 else 0.0}
    gain_percent = c.K * y_span / u_span
    integral = 0.0 if math.isinf(c.Ti_s) else 1.0 / c.Ti_s
    values: dict[str, float]
    match form:
        case "isa":
            values = {"K": c.K, "Ti_s": c.Ti_s, "Td_s": c.Td_s, "Tf_s": c.Tf_s}
        case "parallel":
            values = {"Kp": c.K, "Ki_per_s": c.K * integral, "Kd_s": c.K * c.Td_s, "Tf_s": c.Tf_s}
        case "series":
            values = _series(c)
        case "velocity":
            if not sample_time_s > 0.0:
                raise DesignError("the velocity form needs a sample time", where=form, remedy="give it in seconds")
            d, i = c.Td_s / sample_time_s, sample_time_s * integral
            values = {"q0": c.K * (1 + i + d), "q1": -c.K * (1 + 2 * d), "q2": c.K * d, "Tf_s": c.Tf_s}
        case "siemens":
            K, Ti, Td, filter_s = _derivative_filtered(c, form)
            values = {"Gain": K, "Ti": 0.0 if math.isinf(Ti) else Ti, "Td": Td}
            values |= {"TdFiltRatio": filter_s / Td if Td > 0.0 else 0.2, "PWeighting": c.setpoint_weight}
            values |= {"DWeighting": 0.0}
        case "rockwell-dependent":
            values = {"PGain": gain_percent, "IGain_min": c.Ti_s / 60.0 if integral else 0.0}
            values |= {"DGain_min": c.Td_s / 60.0, "pv_filter_s": c.Tf_s}
        case "rockwell-independent":
            values = {"PGain": gain_percent, "IGain_per_min": gain_percent * integral * 60.0}
            values |= {"DGain_min": gain_percent * c.Td_s / 60.0, "pv_filter_s": c.Tf_s}
        case "schneider-mixed":
            K, Ti, Td, filter_s = _derivative_filtered(c, form)
            values = {"kp": K, "ti": 0.0 if math.isinf(Ti) else Ti, "td": Td, "kd": _derivative_gain(Td, filter_s)}
        case "schneider-parallel":
            K, Ti, Td, filter_s = _derivative_filtered(c, form)
            ratio = u_span / y_span
            values = {"kp": K, "ti": 0.0 if math.isinf(Ti) else Ti * ratio / K, "td": Td * K / ratio}
            values["kd"] = _derivative_gain(values["td"], filter_s)
    return Settings(form=form, values=values | action, u_span=u_span, y_span=y_span, sample_time_s=sample_time_s)


def from_form(settings: Settings) -> PIDController:
    """Return the controller that the settings amount to; inverse of :func:`to_form`.

    The set-point weight comes back only from forms that have one.
    """
    v = settings.values
    sign = 1.0 if v["reverse_acting"] else -1.0
    ratio = settings.u_span / settings.y_span
    weight = 1.0
    Tf = 0.0
    match settings.form:
        case "isa":
            K, Ti, Td, Tf = v["K"], v["Ti_s"], v["Td_s"], v["Tf_s"]
        case "parallel":
            K, Ti, Td, Tf = v["Kp"], _inverse(v["Ki_per_s"] / v["Kp"]), v["Kd_s"] / v["Kp"], v["Tf_s"]
        case "series":
            total = v["Ti_s"] + v["Td_s"]
            K, Ti, Td, Tf = v["K"] * total / v["Ti_s"], total, v["Ti_s"] * v["Td_s"] / total, v["Tf_s"]
        case "velocity":
            T_s, K = settings.sample_time_s, -v["q1"] - 2.0 * v["q2"]
            Ti, Td, Tf = _inverse((v["q0"] + v["q1"] + v["q2"]) / (K * T_s)), v["q2"] * T_s / K, v["Tf_s"]
        case "siemens":
            Ti, filter_s = v["Ti"] or math.inf, v["TdFiltRatio"] * v["Td"]
            K, Ti, Td, Tf = _measurement_filtered(v["Gain"], Ti, v["Td"], filter_s)
            weight = v["PWeighting"]
        case "rockwell-dependent":
            K, Ti, Td = v["PGain"] * ratio, v["IGain_min"] * 60.0 or math.inf, v["DGain_min"] * 60.0
            Tf = v["pv_filter_s"]
        case "rockwell-independent":
            K, Ti = v["PGain"] * ratio, _inverse(v["IGain_per_min"] / v["PGain"] / 60.0)
            Td, Tf = v["DGain_min"] / v["PGain"] * 60.0, v["pv_filter_s"]
        case "schneider-mixed":
            filter_s = v["td"] / v["kd"] if v["td"] else 0.0
            K, Ti, Td, Tf = _measurement_filtered(v["kp"], v["ti"] or math.inf, v["td"], filter_s)
        case "schneider-parallel":
            filter_s = v["td"] / v["kd"] if v["td"] else 0.0
            Ti, Td = v["ti"] * v["kp"] / ratio or math.inf, v["td"] * ratio / v["kp"]
            K, Ti, Td, Tf = _measurement_filtered(v["kp"], Ti, Td, filter_s)
    return PIDController(K=sign * K, Ti_s=Ti, Td_s=Td, Tf_s=Tf, setpoint_weight=weight)


def _inverse(rate: float) -> float:
    return 1.0 / rate if rate > 0.0 else math.inf


def _series(c: PIDController) -> dict[str, float]:
    if math.isinf(c.Ti_s):
        raise DesignError("the series form needs integral action", where="series", remedy="use the parallel form")
    discriminant = 1.0 - 4.0 * c.Td_s / c.Ti_s
    if discriminant < 0.0:
        raise DesignError(
            f"Ti = {c.Ti_s:.4g} s is below 4 Td = {4 * c.Td_s:.4g} s: the controller's zeros are complex",
            where="series",
            remedy="use a parallel form",
        )
    Ti = 0.5 * c.Ti_s * (1.0 + math.sqrt(discriminant))
    return {"K": c.K * Ti / c.Ti_s, "Ti_s": Ti, "Td_s": c.Ti_s - Ti, "Tf_s": c.Tf_s}


def _derivative_filtered(c: PIDController, form: str) -> tuple[float, float, float, float]:
    """Return K, T_I, T_d, T_filter of K (1 + 1/(T_I s) + T_d s/(1 + T_filter s)) equal to C, by partial fractions."""
    if c.Tf_s == 0.0:
        if c.Td_s > 0.0:
            raise DesignError("derivative action without filter", where=form, remedy="give the controller a Tf above 0")
        return c.K, c.Ti_s, 0.0, 0.0
    share = 1.0 if math.isinf(c.Ti_s) else (c.Ti_s - c.Tf_s) / c.Ti_s
    Td = c.Td_s / share - c.Tf_s if share > 0.0 else -1.0
    if share <= 0.0 or Td < 0.0:
        raise DesignError(
            "this form filters the derivative only, and the controller's filter is slower than its derivative",
            where=form,
            remedy="filter the measurement ahead of the block with Tf, and enter the controller with Tf = 0 and Td = 0",
        )
    return c.K * share, c.Ti_s * share, Td, c.Tf_s


def _measurement_filtered(K: float, Ti: float, Td: float, filter_s: float) -> tuple[float, float, float, float]:
    """Inverse of :func:`_derivative_filtered`."""
    if math.isinf(Ti):
        return K, Ti, Td + filter_s, filter_s
    total = Ti + filter_s
    return K * total / Ti, total, Ti * (filter_s + Td) / total, filter_s


def _derivative_gain(Td: float, filter_s: float) -> float:
    return Td / filter_s if filter_s > 0.0 else 10.0
