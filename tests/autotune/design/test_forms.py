"""Vendor forms by their manuals' formulas, and the law in C and Structured Text sample by sample."""

from __future__ import annotations

import ctypes
import math
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.controller import PIDController
from autotune.controller_forms import FORMS, ControllerForm, Settings, from_form, require_complete, to_form
from autotune.design.codegen import c_source, structured_text
from autotune.design.law import PILaw
from autotune.errors import DesignError, InputError

OMEGA = np.geomspace(1e-3, 1e3, 50)


def _by_the_manual(s: Settings) -> Any:
    """Feedback from -y to u that the settings amount to, written from the makers' formulas."""
    v, p = s.values, 1j * OMEGA
    ratio = s.spans.ratio
    match s.form:
        case "siemens":
            integral = 1.0 / (v["Ti"] * p) if v["Ti"] else 0.0
            C = v["Gain"] * (1.0 + integral + v["Td"] * p / (v["TdFiltRatio"] * v["Td"] * p + 1.0))
        case "rockwell-dependent":
            integral = 1.0 / (60.0 * v["IGain_min"] * p) if v["IGain_min"] else 0.0
            C = ratio * v["PGain"] * (1.0 + integral + 60.0 * v["DGain_min"] * p) / (1.0 + v["pv_filter_s"] * p)
        case "rockwell-independent":
            C = ratio * (v["PGain"] + v["IGain_per_min"] / (60.0 * p) + 60.0 * v["DGain_min"] * p)
            C = C / (1.0 + v["pv_filter_s"] * p)
        case "schneider-mixed":
            integral = 1.0 / (v["ti"] * p) if v["ti"] else 0.0
            C = v["kp"] * (1.0 + integral + v["td"] * p / (1.0 + v["td"] / v["kd"] * p))
        case "schneider-parallel":
            integral = 1.0 / (v["ti"] * p) if v["ti"] else 0.0
            C = v["kp"] + ratio * (integral + v["td"] * p / (1.0 + v["td"] / v["kd"] * p))
        case "proportional-band":
            integral = 1.0 / (60.0 * v["reset_min"] * p)
            C = (
                100.0
                * ratio
                / v["PB_percent"]
                * (1.0 + integral + 60.0 * v["rate_min"] * p)
                / (1.0 + v["pv_filter_s"] * p)
            )
        case "series":
            C = v["K"] * (1.0 + 1.0 / (v["Ti_s"] * p)) * (1.0 + v["Td_s"] * p) / (1.0 + v["Tf_s"] * p)
        case "parallel":
            C = (v["Kp"] + v["Ki_per_s"] / p + v["Kd_s"] * p) / (1.0 + v["Tf_s"] * p)
        case _:
            C = v["K"] * (1.0 + 1.0 / (v["Ti_s"] * p) + v["Td_s"] * p) / (1.0 + v["Tf_s"] * p)
    return C if v["reverse_acting"] else -C


controllers = st.builds(
    lambda K, Ti, Td, Tf: PIDController(K=K, Ti_s=Ti, Td_s=Td * Ti, Tf_s=Tf * Td * Ti),
    K=st.one_of(st.floats(-10.0, -0.01), st.floats(0.01, 10.0)),
    Ti=st.floats(0.1, 100.0),
    Td=st.one_of(st.just(0.0), st.floats(0.02, 0.24)),
    Tf=st.floats(0.05, 0.8),
)


@pytest.mark.parametrize("form", [form for form in FORMS if form != "velocity"])
@given(controller=controllers, u_span=st.floats(0.5, 100.0), y_span=st.floats(0.5, 100.0))
@settings(max_examples=20)
def test_settings_give_the_controllers_response_by_the_makers_formula(
    form: str, controller: PIDController, u_span: float, y_span: float
) -> None:
    found = to_form(controller, form, u_span=u_span, y_span=y_span)
    np.testing.assert_allclose(_by_the_manual(found), controller.response(OMEGA), rtol=1e-9)


@pytest.mark.parametrize("form", FORMS)
@given(controller=controllers)
@settings(max_examples=20)
def test_round_trip(form: str, controller: PIDController) -> None:
    back = from_form(to_form(controller, form, u_span=10.0, y_span=4.0, sample_time_s=0.05))
    np.testing.assert_allclose(back.response(OMEGA), controller.response(OMEGA), rtol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_a_record_names_every_setting_of_its_form(form: str) -> None:
    record, spans = FORMS[form], {"u_span": 10.0, "y_span": 4.0, "sample_time_s": 0.05}
    given = to_form(PIDController(K=2.0, Ti_s=8.0, Td_s=1.0, Tf_s=0.2), form, **spans).values
    assert set(record.settings) == set(given) - {"reverse_acting"}
    assert set(record.signed) <= set(record.settings)
    # a P controller needs none of the settings that a controller may lack
    plain = PIDController(K=2.0, Ti_s=8.0 if form == "series" else math.inf)
    lacking = {name: value for name, value in record.settings.items() if not math.isnan(value)}
    assert {name: to_form(plain, form, **spans).values[name] for name in lacking} == lacking


def test_proportional_band_is_the_span_in_percent_that_moves_the_output_fully() -> None:
    # 50 degC of a span of 200 degC move a valve from 0 to 100 %: a band of 25 %, K = 2 %/degC
    found = to_form(PIDController(K=2.0, Ti_s=90.0), "proportional-band", u_span=100.0, y_span=200.0).values
    assert (found["PB_percent"], found["reset_min"]) == (25.0, 1.5)


def test_velocity_form_sums_to_the_positional_law() -> None:
    controller = PIDController(K=2.0, Ti_s=1.5, Td_s=0.2)
    q = to_form(controller, "velocity", sample_time_s=0.1).values
    law = PILaw(controller=controller, sample_time_s=0.1)
    y = np.random.default_rng(0).normal(size=30)
    state, u = law.initial(0.0, 0.0, 0.0), 0.0
    e = np.concatenate(([0.0, 0.0], -y))
    for k in range(30):
        u += q["q0"] * e[k + 2] + q["q1"] * e[k + 1] + q["q2"] * e[k]
        positional, state = law.step(state, 0.0, float(y[k]))
        assert u == pytest.approx(positional, abs=1e-9)


def test_rockwells_example_of_units() -> None:
    # PI with K = 2 % per %, T_I = 30 s: half a minute per repeat, or 4 repeats per minute of gain 2
    controller = PIDController(K=2.0, Ti_s=30.0)
    assert to_form(controller, "rockwell-dependent").values["IGain_min"] == 0.5
    assert to_form(controller, "rockwell-independent").values["IGain_per_min"] == 4.0


@pytest.mark.parametrize(
    ("controller", "form", "reason"),
    [
        (PIDController(K=1.0, Ti_s=1.0, Td_s=0.5, Tf_s=0.1), "series", "complex"),
        (PIDController(K=1.0, Ti_s=1.0, Td_s=0.1), "siemens", "without filter"),
        (PIDController(K=1.0, Ti_s=1.0, Td_s=0.1, Tf_s=0.5), "schneider-mixed", "filter is slower"),
        (PIDController(K=1.0, Ti_s=1.0), "velocity", "sample time"),
    ],
)
def test_what_a_form_cannot_say_is_refused(controller: PIDController, form: str, reason: str) -> None:
    with pytest.raises(DesignError, match=reason):
        to_form(controller, form)


LAWS = [
    PILaw(controller=PIDController(K=-0.035, Ti_s=4.1), sample_time_s=0.01, u_min=0.0, u_max=10.0, u_rate=20.0),
    PILaw(
        controller=PIDController(K=1.7, Ti_s=0.8, Td_s=0.15, Tf_s=0.04, setpoint_weight=0.6),
        sample_time_s=0.02,
        u_min=-2.0,
        u_max=2.0,
    ),
    PILaw(controller=PIDController(K=0.5, Ti_s=math.inf), sample_time_s=0.1),
]


def _signals() -> tuple[list[float], list[float]]:
    rng = np.random.default_rng(5)
    r = np.repeat([5.0, 6.5, -3.0, 5.0], 60)
    return [float(x) for x in r], [float(x) for x in r * 0.7 + rng.normal(size=240)]


def _expected(law: PILaw) -> list[float]:
    r, y = _signals()
    state = law.initial(1.0, r[0], y[0])
    out = []
    for k in range(len(r)):
        u, state = law.step(state, r[k], y[k])
        out.append(u)
    return out


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler: apt-get install gcc")
@pytest.mark.parametrize("law", LAWS, ids=["ball", "pid", "p only"])
def test_compiled_c_answers_as_the_law_does(law: PILaw, tmp_path: Path) -> None:
    source, library = tmp_path / "law.c", tmp_path / "law.so"
    source.write_text(c_source(law))
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off", "-shared", "-fPIC"]
    subprocess.run(["cc", *flags, "-o", str(library), str(source)], check=True)
    code = ctypes.CDLL(str(library))
    code.control_step.restype = ctypes.c_double
    code.control_init.restype = None
    state = (ctypes.c_double * 3)()
    r, y = _signals()
    code.control_init(state, ctypes.c_double(1.0), ctypes.c_double(r[0]), ctypes.c_double(y[0]))
    answers = [code.control_step(state, ctypes.c_double(a), ctypes.c_double(b)) for a, b in zip(r, y, strict=True)]
    np.testing.assert_allclose(answers, _expected(law), rtol=0, atol=1e-12)


def _translated(text: str) -> str:
    """Python source of the function block's body: assignments, IF/ELSE and LIMIT are all it uses."""
    body = text.split("END_VAR")[-1].split("END_FUNCTION_BLOCK")[0]
    lines = []
    indent = ""
    for line in (line.strip() for line in body.strip().splitlines()):
        if line.startswith("IF "):
            lines.append(f"if {line[3:].removesuffix(' THEN')}:")
            indent = "    "
        elif line == "ELSE":
            lines.append("else:")
        elif line == "END_IF;":
            indent = ""
        else:
            name, value = re.fullmatch(r"(\w+) := (.*);", line).groups()  # type: ignore[union-attr] # fails loudly
            lines.append(f"{indent}{name} = {value}")
    return "\n".join(lines)


@pytest.mark.parametrize("law", LAWS, ids=["ball", "pid", "p only"])
def test_structured_text_answers_as_the_law_does(law: PILaw) -> None:
    code = compile(_translated(structured_text(law)), "block", "exec")
    names: dict[str, Any] = {
        "LIMIT": lambda low, value, high: min(max(value, low), high),
        "HOLD": True,
        "U_HELD": 1.0,
    }
    r, y = _signals()
    names |= {"R": r[0], "Y": y[0]}
    exec(code, names)  # the block's own statements
    names["HOLD"] = False
    answers = []
    for a, b in zip(r, y, strict=True):
        names |= {"R": a, "Y": b}
        exec(code, names)
        answers.append(names["U"])
    np.testing.assert_allclose(answers, _expected(law), rtol=0, atol=1e-12)


def test_structured_text_has_standard_literals_only() -> None:
    text = structured_text(PILaw(controller=PIDController(K=-1e-7, Ti_s=3.0), sample_time_s=1e-3))
    assert "inf" not in text.split("*)")[1]
    assert not re.search(r"[*+:=] -", text.split("*)")[1])
    for literal in re.findall(r"(?<![A-Z_])\d[\d.]*(?:E-?\d+)?", text.split("*)")[1]):
        assert re.fullmatch(r"\d+\.\d+(E-?\d+)?", literal)


ISA = FORMS["isa"]


@pytest.mark.parametrize(
    ("form", "message"),
    [
        (replace(ISA, settings={"K": math.nan}), "form mine: encode gives K, Td_s, Tf_s, Ti_s, and settings has K;"),
        (replace(ISA, signed=()), r"signed = \(\) is not among its settings"),
        (replace(ISA, signed=("Kp",)), r"signed = \(Kp\) is not among its settings"),
        (replace(ISA, decode=FORMS["parallel"].decode), "decode asks for 'Kp'"),
        (replace(ISA, decode=lambda v, spans: PIDController(K=-v["K"], Ti_s=v["Ti_s"])), "decode makes K = -2 of"),
    ],
)
def test_a_form_whose_parts_do_not_belong_together_is_refused_by_name(form: ControllerForm, message: str) -> None:
    require_complete(FORMS)
    with pytest.raises(InputError, match=message):
        require_complete({**FORMS, "mine": form})
