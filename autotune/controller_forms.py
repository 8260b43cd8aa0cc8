"""Gains in the forms of common controllers, and back: one record for each form, in one table.

Each form is what its maker's manual calls by these names:

- ``isa``: K (1 + 1/(T_I s) + T_d s) on a measurement filtered with T_f, as everywhere in this project;
- ``parallel``: Kp + Ki/s + Kd s, measurement filter T_f;
- ``series``: K' (1 + 1/(T_I' s)) (1 + T_d' s), measurement filter T_f; exists for T_I >= 4 T_d;
- ``velocity``: du[k] = q0 e[k] + q1 e[k-1] + q2 e[k-2], backward differences, measurement filter T_f;
- ``proportional-band``: percent of the measurement's span for full output, times in minutes: pneumatic controllers and
  their successors;
- ``siemens``: PID_Compact (S7-1200/1500): Gain ((b w - x) + 1/(Ti s)(w - x) + Td s/(TdFiltRatio Td s + 1)(c w - x));
- ``rockwell-dependent``, ``rockwell-independent``: PIDE (Logix): gains on percent of span, times in minutes;
- ``schneider-mixed``, ``schneider-parallel``: PIDFF (Control Expert): derivative Td s/(1 + Td/Kd s); in the parallel
  structure the integral and derivative parts carry the ratio of the output's span to the measurement's.

Makers take positive gains and an action: ``reverse_acting`` is 1 where a rising measurement lowers the output (K > 0).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

from autotune.errors import DesignError, InputError

if TYPE_CHECKING:
    from autotune.controller import PIDController

_NEEDED = math.nan


@dataclass(frozen=True, kw_only=True)
class Spans:
    """What a form's settings are relative to.

    Attributes
    ----------
    u, y : float
        Engineering spans of output and measurement, for forms in percent or with span ratios.
    sample_time_s : float
        Of the velocity form [s]; 0 elsewhere.
    """

    u: float = 1.0
    y: float = 1.0
    sample_time_s: float = 0.0

    @property
    def ratio(self) -> float:
        """Output's span over the measurement's: engineering gain of a gain of 1 % per %."""
        return self.u / self.y


#: settings by the maker's names; times in the maker's unit, which the name says where it is not seconds
Values: TypeAlias = Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class ControllerForm:
    """A form: what its settings are called, and the way there and back.

    Attributes
    ----------
    settings : mapping of str to float
        Names of the settings, each with the value that a controller behaves as where it has no such setting; NaN where
        every controller of the form has it.
    signed : tuple of str
        Settings that change sign with K, on a controller without an action of its own.
    encode : callable
        From a controller with K >= 0 to settings with exactly its feedback C(s); raises DesignError where there are
        none.
    decode : callable
        The inverse; K >= 0.
    """

    settings: Values
    signed: tuple[str, ...]
    encode: Callable[[PIDController, Spans], Values]
    decode: Callable[[Values, Spans], PIDController]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What to type into a controller.

    Attributes
    ----------
    form : str
        A key of ``FORMS``.
    values : mapping of str to float
        Settings by the maker's names, and ``reverse_acting``.
    spans : Spans
        What they are relative to.
    """

    form: str
    values: Values
    spans: Spans = Spans()


def to_form(
    controller: PIDController, form: str, *, u_span: float = 1.0, y_span: float = 1.0, sample_time_s: float = 0.0
) -> Settings:
    """Return the settings with which the form has exactly the controller's feedback C(s).

    Parameters
    ----------
    controller : PIDController
        K with its sign.
    form : str
        A key of ``FORMS``.
    u_span, y_span : float
        Engineering spans, for the forms in percent and Schneider's.
    sample_time_s : float
        For the velocity form [s].

    Raises
    ------
    DesignError
        The form cannot express the controller exactly; the message says why.
    """
    if not u_span > 0.0 or not y_span > 0.0:
        raise DesignError("spans must be positive", where=form)
    spans = Spans(u=u_span, y=y_span, sample_time_s=sample_time_s)
    require_complete({form: FORMS[form]})
    values = FORMS[form].encode(replace(controller, K=abs(controller.K)), spans)
    action = {"reverse_acting": 1.0 if controller.K >= 0.0 else 0.0}
    return Settings(form=form, values={**values, **action}, spans=spans)


def from_form(settings: Settings) -> PIDController:
    """Return the controller that the settings amount to; inverse of :func:`to_form`.

    The set-point weight comes back only from forms that have one.
    """
    require_complete({settings.form: FORMS[settings.form]})
    found = FORMS[settings.form].decode(settings.values, settings.spans)
    return replace(found, K=found.K if settings.values["reverse_acting"] else -found.K)


def _pid(K: float, Ti_s: float, Td_s: float = 0.0, Tf_s: float = 0.0) -> PIDController:
    # imported here: the command line needs the names of the forms alone, and its help is there in half the time
    from autotune.controller import PIDController

    return PIDController(K=K, Ti_s=Ti_s, Td_s=Td_s, Tf_s=Tf_s)


def _isa(c: PIDController, spans: Spans) -> Values:
    return {"K": c.K, "Ti_s": c.Ti_s, "Td_s": c.Td_s, "Tf_s": c.Tf_s}


def _of_isa(v: Values, spans: Spans) -> PIDController:
    return _pid(K=v["K"], Ti_s=v["Ti_s"], Td_s=v["Td_s"], Tf_s=v["Tf_s"])


def _parallel(c: PIDController, spans: Spans) -> Values:
    return {"Kp": c.K, "Ki_per_s": c.K / c.Ti_s, "Kd_s": c.K * c.Td_s, "Tf_s": c.Tf_s}


def _of_parallel(v: Values, spans: Spans) -> PIDController:
    K = v["Kp"]
    return _pid(K=K, Ti_s=_inverse(_over(v["Ki_per_s"], K)), Td_s=_over(v["Kd_s"], K), Tf_s=v["Tf_s"])


def _series(c: PIDController, spans: Spans) -> Values:
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


def _of_series(v: Values, spans: Spans) -> PIDController:
    if v["Ti_s"] == 0.0:  # as delivered
        return _pid(K=v["K"], Ti_s=math.inf, Tf_s=v["Tf_s"])
    total = v["Ti_s"] + v["Td_s"]
    return _pid(K=v["K"] * total / v["Ti_s"], Ti_s=total, Td_s=v["Ti_s"] * v["Td_s"] / total, Tf_s=v["Tf_s"])


def _velocity(c: PIDController, spans: Spans) -> Values:
    T_s = spans.sample_time_s
    if not T_s > 0.0:
        raise DesignError("the velocity form needs a sample time", where="velocity", remedy="give it in seconds")
    d, i = c.Td_s / T_s, T_s / c.Ti_s
    return {"q0": c.K * (1 + i + d), "q1": -c.K * (1 + 2 * d), "q2": c.K * d, "Tf_s": c.Tf_s}


def _of_velocity(v: Values, spans: Spans) -> PIDController:
    T_s, K = spans.sample_time_s, -v["q1"] - 2.0 * v["q2"]
    i = _over(v["q0"] + v["q1"] + v["q2"], K) / T_s
    # the three sum to the integral's share, of which rounding leaves a trace where there is none
    i = i if abs(i) * T_s > 1e-12 else 0.0
    return _pid(K=K, Ti_s=_inverse(i), Td_s=_over(v["q2"], K) * T_s, Tf_s=v["Tf_s"])


def _band(c: PIDController, spans: Spans) -> Values:
    return {
        "PB_percent": _over(100.0 * spans.ratio, c.K),
        "reset_min": c.Ti_s / 60.0,
        "rate_min": c.Td_s / 60.0,
        "pv_filter_s": c.Tf_s,
    }


def _of_band(v: Values, spans: Spans) -> PIDController:
    K = _over(100.0 * spans.ratio, v["PB_percent"])
    return _pid(K=K, Ti_s=60.0 * v["reset_min"], Td_s=60.0 * v["rate_min"], Tf_s=v["pv_filter_s"])


def _siemens(c: PIDController, spans: Spans) -> Values:
    K, Ti, Td, filter_s = _derivative_filtered(c, "siemens")
    return {
        "Gain": K,
        "Ti": _zero_for_never(Ti),
        "Td": Td,
        "TdFiltRatio": filter_s / Td if Td > 0.0 else 0.2,
        "PWeighting": c.setpoint_weight,
        "DWeighting": 0.0,
    }


def _of_siemens(v: Values, spans: Spans) -> PIDController:
    found = _measurement_filtered(v["Gain"], v["Ti"] or math.inf, v["Td"], v["TdFiltRatio"] * v["Td"])
    return replace(found, setpoint_weight=v["PWeighting"])


def _rockwell_dependent(c: PIDController, spans: Spans) -> Values:
    minutes = {"IGain_min": _zero_for_never(c.Ti_s) / 60.0, "DGain_min": c.Td_s / 60.0}
    return {"PGain": c.K / spans.ratio, **minutes, "pv_filter_s": c.Tf_s}


def _of_rockwell_dependent(v: Values, spans: Spans) -> PIDController:
    Ti = v["IGain_min"] * 60.0 or math.inf
    return _pid(K=v["PGain"] * spans.ratio, Ti_s=Ti, Td_s=v["DGain_min"] * 60.0, Tf_s=v["pv_filter_s"])


def _rockwell_independent(c: PIDController, spans: Spans) -> Values:
    P = c.K / spans.ratio
    return {"PGain": P, "IGain_per_min": P / c.Ti_s * 60.0, "DGain_min": P * c.Td_s / 60.0, "pv_filter_s": c.Tf_s}


def _of_rockwell_independent(v: Values, spans: Spans) -> PIDController:
    P = v["PGain"]
    Ti, Td = _inverse(_over(v["IGain_per_min"], P) / 60.0), _over(v["DGain_min"], P) * 60.0
    return _pid(K=P * spans.ratio, Ti_s=Ti, Td_s=Td, Tf_s=v["pv_filter_s"])


def _schneider_mixed(c: PIDController, spans: Spans) -> Values:
    K, Ti, Td, filter_s = _derivative_filtered(c, "schneider-mixed")
    return {"kp": K, "ti": _zero_for_never(Ti), "td": Td, "kd": _derivative_gain(Td, filter_s)}


def _of_schneider_mixed(v: Values, spans: Spans) -> PIDController:
    filter_s = _over(v["td"], v["kd"])
    return _measurement_filtered(v["kp"], v["ti"] or math.inf, v["td"], filter_s)


def _schneider_parallel(c: PIDController, spans: Spans) -> Values:
    K, Ti, Td, filter_s = _derivative_filtered(c, "schneider-parallel")
    td = Td * K / spans.ratio
    ti = _over(_zero_for_never(Ti) * spans.ratio, K)
    return {"kp": K, "ti": ti, "td": td, "kd": _derivative_gain(td, filter_s)}


def _of_schneider_parallel(v: Values, spans: Spans) -> PIDController:
    filter_s = _over(v["td"], v["kd"])
    Ti, Td = v["ti"] * v["kp"] / spans.ratio or math.inf, _over(v["td"] * spans.ratio, v["kp"])
    return _measurement_filtered(v["kp"], Ti, Td, filter_s)


#: every form by its name: a further one is a further entry
FORMS: Mapping[str, ControllerForm] = {
    "isa": ControllerForm(
        settings={"K": _NEEDED, "Ti_s": math.inf, "Td_s": 0.0, "Tf_s": 0.0},
        signed=("K",),
        encode=_isa,
        decode=_of_isa,
    ),
    "parallel": ControllerForm(
        settings={"Kp": _NEEDED, "Ki_per_s": 0.0, "Kd_s": 0.0, "Tf_s": 0.0},
        signed=("Kp", "Ki_per_s", "Kd_s"),
        encode=_parallel,
        decode=_of_parallel,
    ),
    "series": ControllerForm(
        settings={"K": _NEEDED, "Ti_s": _NEEDED, "Td_s": 0.0, "Tf_s": 0.0},
        signed=("K",),
        encode=_series,
        decode=_of_series,
    ),
    "velocity": ControllerForm(
        settings={"q0": _NEEDED, "q1": _NEEDED, "q2": 0.0, "Tf_s": 0.0},
        signed=("q0", "q1", "q2"),
        encode=_velocity,
        decode=_of_velocity,
    ),
    "proportional-band": ControllerForm(
        settings={"PB_percent": _NEEDED, "reset_min": math.inf, "rate_min": 0.0, "pv_filter_s": 0.0},
        signed=("PB_percent",),
        encode=_band,
        decode=_of_band,
    ),
    "siemens": ControllerForm(
        settings={"Gain": _NEEDED, "Ti": 0.0, "Td": 0.0, "TdFiltRatio": 0.2, "PWeighting": 1.0, "DWeighting": 0.0},
        signed=("Gain",),
        encode=_siemens,
        decode=_of_siemens,
    ),
    "rockwell-dependent": ControllerForm(
        settings={"PGain": _NEEDED, "IGain_min": 0.0, "DGain_min": 0.0, "pv_filter_s": 0.0},
        signed=("PGain",),
        encode=_rockwell_dependent,
        decode=_of_rockwell_dependent,
    ),
    "rockwell-independent": ControllerForm(
        settings={"PGain": _NEEDED, "IGain_per_min": 0.0, "DGain_min": 0.0, "pv_filter_s": 0.0},
        signed=("PGain", "IGain_per_min", "DGain_min"),
        encode=_rockwell_independent,
        decode=_of_rockwell_independent,
    ),
    "schneider-mixed": ControllerForm(
        settings={"kp": _NEEDED, "ti": 0.0, "td": 0.0, "kd": 10.0},
        signed=("kp",),
        encode=_schneider_mixed,
        decode=_of_schneider_mixed,
    ),
    "schneider-parallel": ControllerForm(
        settings={"kp": _NEEDED, "ti": 0.0, "td": 0.0, "kd": 10.0},
        signed=("kp", "ti", "td"),
        encode=_schneider_parallel,
        decode=_of_schneider_parallel,
    ),
}


def require_complete(forms: Mapping[str, ControllerForm]) -> None:
    """Refuse forms whose parts do not belong together.

    Parameters
    ----------
    forms : mapping of str to ControllerForm
        The table.

    Raises
    ------
    InputError
        The first that is wrong, with what is missing and how to add it.
    """
    usual, spans = _pid(K=2.0, Ti_s=8.0, Td_s=1.0, Tf_s=0.1), Spans(u=100.0, y=50.0, sample_time_s=0.1)
    for name, form in forms.items():
        settings, values = set(form.settings), form.encode(usual, spans)
        if settings != set(values):
            what = f"encode gives {', '.join(sorted(values))}, and settings has {', '.join(sorted(settings))}"
            raise InputError(what, where=f"form {name}", remedy="name the same settings in both")
        if not (form.signed and set(form.signed) <= settings):
            what = f"signed = ({', '.join(form.signed)}) is not among its settings"
            raise InputError(what, where=f"form {name}", remedy="name the settings that change sign with K")
        try:
            again = form.decode(values, spans)
        except KeyError as missing:
            what = f"decode asks for {missing}, which is not among its settings"
            raise InputError(what, where=f"form {name}", remedy="name the same settings in both") from None
        if not math.isclose(again.K, usual.K, rel_tol=1e-9):
            what = f"decode makes K = {again.K:g} of what encode made of K = {usual.K:g}"
            raise InputError(what, where=f"form {name}", remedy="make decode the inverse of encode")


def _zero_for_never(Ti_s: float) -> float:
    """Return an integral time as makers write it who switch integral action off by 0."""
    return 0.0 if math.isinf(Ti_s) else Ti_s


def _inverse(rate: float) -> float:
    return 1.0 / rate if rate > 0.0 else math.inf


def _over(value: float, divisor: float) -> float:
    """Return a quotient that is 0 where a controller as delivered has a gain of 0."""
    return value / divisor if divisor else 0.0


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


def _measurement_filtered(K: float, Ti: float, Td: float, filter_s: float) -> PIDController:
    """Inverse of :func:`_derivative_filtered`."""
    if math.isinf(Ti):
        return _pid(K=K, Ti_s=Ti, Td_s=Td + filter_s, Tf_s=filter_s)
    total = Ti + filter_s
    return _pid(K=K * total / Ti, Ti_s=total, Td_s=Ti * (filter_s + Td) / total, Tf_s=filter_s)


def _derivative_gain(Td: float, filter_s: float) -> float:
    return Td / filter_s if filter_s > 0.0 else 10.0
