"""Between a controller and the settings that a device holds in its maker's form: pure functions of the register map."""

from __future__ import annotations

import math
from collections.abc import Mapping

from autotune.config.registers import GainSettings
from autotune.controller import PIDController
from autotune.controller_forms import Settings, from_form, to_form
from autotune.errors import InputError

#: how far what a device cannot be told may be from what the controller needs, relative
_SAME = 1e-6


def settings_of(gains: GainSettings, controller: PIDController) -> dict[str, float]:
    """Return the settings to be written, by their names; an integral time of 0 is what registers have for none.

    Where the device has no setting for its action, the settings that carry a gain carry its sign.

    Parameters
    ----------
    gains : GainSettings
        The map of the device's gains.
    controller : PIDController
        What it is to run.

    Raises
    ------
    InputError
        The device has no setting, or another action, for what the controller needs.
    DesignError
        The form cannot express the controller.
    """
    record, spans = gains.record, gains.spans
    found = to_form(controller, gains.form, u_span=spans.u, y_span=spans.y, sample_time_s=spans.sample_time_s)
    values = dict(found.values)
    if not _tells_action(gains):
        values |= {name: -values[name] for name in record.signed if controller.K < 0.0}
    elif gains.fixed.get("reverse_acting", values["reverse_acting"]) != values["reverse_acting"]:
        raise InputError(
            f"K = {controller.K:g} has the other action than the device's ({gains.fixed['reverse_acting']:g})",
            where="rig.registers.gains.fixed.reverse_acting",
            remedy="set the action at the device and here, or check the controller's sign",
        )
    for name, neutral in record.settings.items():
        behaves_as = gains.fixed.get(name, neutral)
        if name not in gains.settings and not math.isclose(values[name], behaves_as, rel_tol=_SAME):
            raise InputError(
                f"the controller needs {name} = {values[name]:.4g}, and the device behaves as with {behaves_as:.4g}",
                where="rig.registers",
                remedy=f"map the register of {name}, or design without it (--kind pi)",
            )
    return {name: 0.0 if math.isinf(values[name]) else values[name] for name in gains.settings}


def controller_of(gains: GainSettings, held: Mapping[str, float]) -> PIDController:
    """Return the controller that the settings amount to; inverse of :func:`settings_of`.

    Parameters
    ----------
    gains : GainSettings
        The form, and which of its settings the device has.
    held : mapping of str to float
        What the registers hold, by setting.
    """
    record = gains.record
    never = {
        name: math.inf for name, value in held.items() if value == 0.0 and math.isinf(record.settings.get(name, 0.0))
    }
    values = {**record.settings, "reverse_acting": 1.0, **gains.fixed, **held, **never}
    if not _tells_action(gains) and values[record.signed[0]] < 0.0:
        values |= {name: -values[name] for name in record.signed} | {"reverse_acting": 0.0}
    return from_form(Settings(form=gains.form, values=values, spans=gains.spans))


def _tells_action(gains: GainSettings) -> bool:
    return "reverse_acting" in gains.settings or "reverse_acting" in gains.fixed
