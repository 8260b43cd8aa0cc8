"""Results as tables: for a notebook (``_repr_html_``) and for pandas."""

from __future__ import annotations

import html as escaping
import math
from collections.abc import Sequence
from functools import singledispatch
from typing import Any

import numpy as np

from autotune.api.points import Points, as_points
from autotune.controller import DiscreteController, PIDController
from autotune.design.margins import Margins
from autotune.design.nugap import Validation
from autotune.design.reference import Trajectory
from autotune.design.rst import RST
from autotune.design.specification import UNCERTAIN, Design
from autotune.errors import InputError
from autotune.identification.closed_loop.identify import ClosedLoopIdentification
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.two_delays import TwoDelays
from autotune.identification.envelope import polar_sd
from autotune.identification.reduction import ReducedModel
from autotune.models import Model, TransferFunction
from autotune.recording import Recording

Row = Sequence[str]


@singledispatch
def rows_of(result: Any) -> tuple[str, Row, list[Row]]:
    """Return the title, the header and the rows of a result's table; a row of one cell is a remark on all of it."""
    raise InputError(f"a {type(result).__name__} has no table", where="show")


@rows_of.register
def _(result: Recording) -> tuple[str, Row, list[Row]]:
    units = result.metadata.get("units", {})
    columns = {"u": result.u, "y": result.y, **result.extra}
    rows = [
        (name, str(units.get(name, "")), *(number(f(values)) for f in (np.nanmin, np.nanmean, np.nanmax, np.nanstd)))
        for name, values in columns.items()
    ]
    title = (
        f"Recording {result.name}: {len(result)} rows, {result.duration_s:.6g} s, {result.sample_time_s:.4g} s apart"
    )
    return title, ("column", "unit", "least", "mean", "largest", "sd"), [*rows]


@rows_of.register
def _(result: Points) -> tuple[str, Row, list[Row]]:
    rows = []
    for point in result:
        gain_sd, phase_sd = polar_sd(point)
        phase = f"{math.degrees(point.phase_rad):.2f}", f"{math.degrees(phase_sd):.2g}"
        rows.append((number(point.omega_rad_s), number(point.gain), f"{100 * gain_sd:.2g} %", *phase, point.source))
    return f"{len(result)} frequency points", ("rad/s", "gain", "sd", "phase [deg]", "sd [deg]", "source"), [*rows]


@rows_of.register
def _(result: ReducedModel) -> tuple[str, Row, list[Row]]:
    form = "G_r (1 - s/w_d) / (s (1 + s/w_d))" if result.integrating else "G_r (1 - s/w_d) / ((1 + s/w_0)(1 + s/w_d))"
    values = [("G_r", result.G_r, result.sd[0]), ("w_d [rad/s]", result.omega_d_rad_s, result.sd[2])]
    if result.omega_0r_rad_s is not None:
        values.insert(1, ("w_0 [rad/s]", result.omega_0r_rad_s, result.sd[1]))
    rows = [(name, number(value), _share(sd) if sd else Cell("exact", 0.0)) for name, value, sd in values]
    return f"Reduced model {form}", ("", "value", "sd"), [*rows, *((text,) for text in result.warnings)]


@rows_of.register
def _(result: Margins) -> tuple[str, Row, list[Row]]:
    rows = [
        ("modulus margin", number(result.modulus), ""),
        ("phase margin", number(math.degrees(result.phase_rad)), "deg"),
        ("delay margin", number(result.delay_s), "s"),
        ("gain margin", number(result.gain), ""),
        ("crossover", number(result.crossover_rad_s), "rad/s"),
        ("noise gain", number(result.noise_gain), "u/y"),
        ("H2 norm", number(result.h2), ""),
    ]
    return (
        "Margins" if result.stable else "UNSTABLE: figures of the Nyquist curve, no margins",
        ("", "", "unit"),
        [*rows],
    )


@rows_of.register
def _(result: PIDController) -> tuple[str, Row, list[Row]]:
    rows = [("K", number(result.K), "u/y"), ("T_I", number(result.Ti_s), "s")]
    if result.kind == "pid":
        rows += [("T_D", number(result.Td_s), "s"), ("T_f", number(result.Tf_s), "s")]
    return f"{result.kind.upper()} controller", ("", "", "unit"), [*rows]


@rows_of.register
def _(result: Design) -> tuple[str, Row, list[Row]]:
    rows: list[Row] = [*rows_of(result.controller)[2], *rows_of(result.margins)[2]]
    rows.append(("binding", ", ".join(result.binding) or "none", ""))
    if result.h2_lower_bound is not None:
        rows.append(("least possible H2", number(result.h2_lower_bound), ""))
    if UNCERTAIN in result.certificate:
        rows.append((result.certificate[result.certificate.index(UNCERTAIN) :],))
    return f"Design: {result.kind.upper()}", ("", "", "unit"), [*rows]


@rows_of.register
def _(result: Validation) -> tuple[str, Row, list[Row]]:
    rows = [
        ("nu-gap of plant and model", number(result.nu_gap)),
        ("b with the model", number(result.b_reduced)),
        ("b with the plant", number(result.b_rig)),
        ("scaling k", number(result.scaling)),
    ]
    return f"Criterion (10) {'holds' if result.holds else 'does not hold'}", ("", ""), [*rows]


@rows_of.register
def _(result: DelayModel) -> tuple[str, Row, list[Row]]:
    n, sd = result.order, result.standard_deviations
    names = [*(f"a{i}" for i in range(n)), "b", "delay [s]", "constant"]
    # what a method estimates without a standard deviation has 0 or NaN there, which is none
    known = zip(names, result.values, sd, strict=False)
    rows = [(name, number(v), number(s) if s > 0.0 else "") for name, v, s in known]
    rows.append(("noise sd", number(result.noise_sd), ""))
    return f"x^({n}) = sum a_i x^(i) + b u(t - h)", ("", "value", "sd"), [*rows]


@rows_of.register
def _(result: TwoDelays) -> tuple[str, Row, list[Row]]:
    names, sds = ("a", "b", "h1 [s]", "h2 [s]"), result.standard_deviations
    rows = [(name, number(v), number(s)) for name, v, s in zip(names, result.values, sds, strict=True)]
    return "x'' + a x(t - h1) = b u(t - h2)", ("", "value", "sd"), [*rows]


@rows_of.register
def _(result: InnovationModel) -> tuple[str, Row, list[Row]]:
    rows = [(_pole(pole), number(abs(pole))) for pole in result.poles]
    return (
        f"State space of order {result.order}, sample time {result.sample_time_s:g} s",
        ("pole", "magnitude"),
        [*rows],
    )


@rows_of.register
def _(result: ClosedLoopIdentification) -> tuple[str, Row, list[Row]]:
    rows = []
    for pole, covariance in zip(result.poles, result.pole_covariance, strict=True):
        sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        rows.append((_pole(pole), number(sd[0]), number(sd[1]) if pole.imag else ""))
    said = dict.fromkeys((result.excitation.sentence, *result.warnings))
    title = f"Plant of order {result.estimate.model.order} from its loop"
    return title, ("pole", "sd (real)", "sd (imaginary)"), [*rows, *((text,) for text in said)]


@rows_of.register(TransferFunction)
@rows_of.register(DiscreteController)
def _(result: TransferFunction | DiscreteController) -> tuple[str, Row, list[Row]]:
    s = "s" if isinstance(result, TransferFunction) else "q^-1"
    order = "descending" if s == "s" else "ascending"
    rows = [("num", _numbers(result.num)), ("den", _numbers(result.den))]
    if isinstance(result, TransferFunction) and result.delay_s:
        rows.append(("dead time [s]", number(result.delay_s)))
    return f"Transfer function, {order} powers of {s}", ("", ""), [*rows]


@rows_of.register
def _(result: RST) -> tuple[str, Row, list[Row]]:
    rows = [(name, _numbers(getattr(result, name))) for name in ("R", "S", "T")]
    return "RST controller S u = T r - R y, descending powers of s", ("", ""), [*rows]


@rows_of.register
def _(result: Trajectory) -> tuple[str, Row, list[Row]]:
    rows = [("duration [s]", number(result.duration_s)), ("decided by", result.binding)]
    return f"Transition from {result.y[0]:.4g} to {result.y[-1]:.4g}", ("", ""), [*rows]


@rows_of.register
def _(result: Model) -> tuple[str, Row, list[Row]]:
    rows = [(block.name, block.place, *rows_of(block.dynamics)[2][0][1:], *rows_of(block.dynamics)[2][1][1:],
             number(block.dynamics.delay_s)) for block in result.blocks]  # fmt: skip
    return f"Model {result.name}", ("block", "place", "num", "den", "delay [s]"), [*rows]


def html(result: Any) -> str:
    """Return a result's table for a notebook."""
    title, header, rows = rows_of(result)
    esc = escaping.escape
    head = "".join(_head(header)) if any(header) else ""
    body = "".join("<tr>" + "".join(_cells(row, len(header))) + "</tr>" for row in rows)
    caption = f'<caption style="text-align: left; white-space: nowrap"><b>{esc(title)}</b></caption>'
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def text(result: Any) -> str:
    """Return a result's table as lines for people."""
    title, header, rows = rows_of(result)
    table = [row for row in (header, *rows) if len(row) > 1 and any(row)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table)
    return "\n".join((title, *lines, *(row[0] for row in rows if len(row) == 1)))


def _head(header: Row) -> list[str]:
    """Return the cells of the header, each above what it names."""
    first, *others = (escaping.escape(cell) for cell in header)
    return [f'<th style="text-align: left">{first}</th>', *(f"<th>{cell}</th>" for cell in others)]


def _cells(row: Row, width: int) -> list[str]:
    """Return the cells of a row: names to the left, numbers as the notebook has them, a remark over the whole width."""
    first, *others = (escaping.escape(str(cell)) for cell in row)
    if not others:
        wide = "text-align: left; white-space: normal; max-width: 40em"
        return [f'<td colspan="{width}" style="{wide}">{first}</td>']
    return [f'<td style="text-align: left">{first}</td>', *(f"<td>{cell}</td>" for cell in others)]


class Cell(str):
    """A number as a table shows it, which remembers the whole of it.

    Attributes
    ----------
    value : float, complex or tuple of float
        All of its digits.
    """

    value: float | complex | tuple[float, ...]

    def __new__(cls, text: str, value: float | complex | tuple[float, ...]) -> Cell:
        """Return the text with the number or coefficients that it stands for."""
        made = super().__new__(cls, text)
        made.value = value
        return made


def _pole(pole: complex) -> Cell:
    return Cell(f"{pole.real:.5g} {pole.imag:+.5g}i" if pole.imag else f"{pole.real:.5g}", complex(pole))


def number(value: Any) -> Cell:
    """Return a number as a table shows it."""
    return Cell(f"{float(value):.5g}", float(value))


def _numbers(values: Sequence[float]) -> Cell:
    return Cell(", ".join(map(number, values)), tuple(map(float, values)))


def _share(value: float) -> Cell:
    """Return a relative standard deviation, shown in per cent."""
    return Cell(f"{100 * value:.2g} %", float(value))


def to_pandas(result: Any) -> Any:
    """Return a recording, points, or any result as a pandas DataFrame.

    Parameters
    ----------
    result : object
        A recording has its time [s] as index and a column each; points have their gain, phase and standard deviations;
        a transition its time, y and u; another result the rows of its table, numbers with all of their digits,
        coefficients as tuples of them, and relative standard deviations as shares. Remarks on all of a table are in
        ``attrs["remarks"]``.

    Returns
    -------
    pandas.DataFrame

    Raises
    ------
    InputError
        pandas is not installed.

    Examples
    --------
    >>> import autotune as at
    >>> list(at.to_pandas(at.example("oven")).columns)
    ['u', 'y']
    """
    try:
        import pandas as pd  # type: ignore[import-untyped, unused-ignore]
    except ImportError:
        raise InputError(
            "pandas is not installed", where="to_pandas", remedy="pip install 'relay-autotune[notebook]'"
        ) from None
    if isinstance(result, Recording):
        columns = {"u": result.u, "y": result.y, **result.extra}
        return pd.DataFrame(columns, index=pd.Index(result.t, name="t"))
    if isinstance(result, Trajectory):
        return pd.DataFrame({"y": result.y, "u": result.u}, index=pd.Index(result.t_s, name="t"))
    points = result if isinstance(result, Points) else None
    if points is None and rows_of.dispatch(type(result)) is rows_of.dispatch(object):  # it has no table of its own
        points = as_points(result)
    if points is not None:
        sds = [polar_sd(point) for point in points]
        return pd.DataFrame(
            {
                "gain": [point.gain for point in points],
                "gain_sd": [sd[0] * point.gain for sd, point in zip(sds, points, strict=True)],
                "phase_deg": [math.degrees(point.phase_rad) for point in points],
                "phase_sd_deg": [math.degrees(sd[1]) for sd in sds],
                "source": [point.source for point in points],
            },
            index=pd.Index([point.omega_rad_s for point in points], name="omega_rad_s"),
        )
    _, header, rows = rows_of(result)
    wide = max(len(header), 2)
    numbers = [[getattr(cell, "value", cell if cell else None) for cell in row] for row in rows if len(row) > 1]
    padded = [[*row, *[None] * (wide - len(row))] for row in numbers]
    frame = pd.DataFrame(padded, columns=[name or str(i) for i, name in enumerate(header)])
    frame.attrs["remarks"] = [str(row[0]) for row in rows if len(row) == 1]
    return frame


for _shown in rows_of.registry.keys() - {object}:
    setattr(_shown, "_repr_html_", html)  # noqa: B010 - the rooms below know nothing of notebooks
# printed as it is, it would be all matrices and residuals of every structure that was tried
setattr(ClosedLoopIdentification, "__str__", text)  # noqa: B010 - see above
setattr(ClosedLoopIdentification, "__repr__", text)  # noqa: B010 - see above
