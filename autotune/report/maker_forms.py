"""A controller's gains as the blocks of makers take them, for whoever types them in."""

from __future__ import annotations

from autotune.controller import PIDController
from autotune.controller_forms import to_form
from autotune.errors import DesignError
from autotune.report.page import Table

#: forms whose settings follow from the gains alone, and what they are called
_WITHOUT_SPANS = {
    "isa": "ISA (ideal, standard)",
    "parallel": "parallel (independent gains)",
    "series": "series (interacting)",
    "siemens": "Siemens PID_Compact",
}


def maker_table(controller: PIDController) -> Table:
    """Return the settings of the forms that follow from the gains alone; the others are named with their command."""
    rows = []
    for form, name in _WITHOUT_SPANS.items():
        try:
            values = dict(to_form(controller, form).values)
        except DesignError as error:
            rows.append((name, f"has no such form: {error.what}"))
            continue
        values.pop("reverse_acting")
        if "Ti_s" in values:
            values["Ti_min"] = values["Ti_s"] / 60.0
        rows.append((name, ", ".join(f"{key} = {value:.4g}" for key, value in values.items())))
    action = (
        "reverse: a rising measurement lowers the output" if controller.K >= 0.0 else "direct: it raises the output"
    )
    return Table(
        caption=f"The same gains as makers' blocks take them; action {action}. Proportional band, Rockwell, Schneider"
        " and the velocity form need spans or a sample time: autotune controller --controller controller.toml"
        " --form NAME --u-span U --y-span Y --sample-time S",
        header=("form", "settings"),
        rows=tuple(rows),
    )
