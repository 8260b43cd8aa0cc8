"""The generator of concealed recordings: its equations against closed forms, its cases against their layout."""

import json
import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.conceal.cases import make, write
from sim.conceal.effects import BY_NAME, EFFECTS, PROCESS, SERVO
from sim.conceal.loop import OPEN_LOOP, Law, Sampling, run_loop
from sim.conceal.physics import N_STATES, SPEED, Physics, command_static
from sim.conceal.retune import Chain, discretise, forecast_error, residuals, retune
from sim.conceal.sizes import Scale

SERVO_TRUTH = Physics(1.0, 50.0, 0.01, 0.2, 0.0, 0.0, 0.0, 0.0)
OVEN_TRUTH = Physics(0.0, 2.9, 9.0, 35.0, 0.0, 2.3, 50.0, 160.0)


def respond(p, u, Ts, start=None, substeps=5):
    N = len(u)
    sampling = Sampling(Ts, np.arange(N) * Ts, np.zeros(N), np.zeros(N), np.zeros(N))
    zero = np.zeros(N_STATES) if start is None else start
    return run_loop(p, Law(kind=OPEN_LOOP), sampling, np.zeros(N), u, substeps, zero)


def chain_of(p):
    return Chain(
        integrating=p.integrating > 0,
        K=p.K,
        tau_actuator=p.tau_actuator,
        tau_plant=p.tau_plant,
        tau_sensor=p.tau_sensor,
        delay=p.delay,
        u_offset=p.u_offset,
        y_offset=p.y_offset,
    )


def test_without_effects_the_event_integrator_is_the_exact_linear_chain():
    rng = np.random.default_rng(0)
    u = 50.0 + np.repeat([0.0, *rng.uniform(-10, 10, 30)], 20)  # at rest until the delay has passed
    y = respond(OVEN_TRUTH, u, 1.0)[1]
    e = residuals(chain_of(OVEN_TRUTH), u, y, 1.0, len(u))
    assert np.max(np.abs(e)) < 1e-5 * np.std(y)


def test_a_body_under_dry_friction_coasts_to_rest_where_the_closed_form_says():
    # tau v' = -v - K F, v(0) = v0: stops at t = tau ln(1 + v0/(K F)), having gone tau v0 - K F t
    v0, F = 30.0, 0.2
    start = np.zeros(N_STATES)
    start[SPEED] = v0
    p = SERVO_TRUTH._replace(coulomb=F, breakaway=F)
    y = respond(p, np.zeros(400), 0.005, start)[1]
    t_stop = 0.2 * np.log(1.0 + v0 / (50.0 * F))
    assert y[-1] == pytest.approx(0.2 * v0 - 50.0 * F * t_stop, rel=1e-6)
    assert y[-1] == pytest.approx(y[int(t_stop / 0.005) + 2], abs=1e-12)


def test_a_stuck_body_leaves_only_above_the_breakaway_level():
    p = SERVO_TRUTH._replace(coulomb=0.2, breakaway=0.3, stribeck_speed=1.0)
    below, above = (respond(p, np.full(200, level), 0.005)[1] for level in (0.29, 0.31))
    assert np.max(np.abs(below)) < 1e-20
    assert above[-1] > 0.5


def test_nothing_passes_a_stop_and_the_stop_lets_go_backwards():
    u = np.concatenate([np.full(200, 1.0), np.full(200, -1.0)])
    y = respond(SERVO_TRUTH._replace(stop=4.0), u, 0.005)[1]
    assert np.max(y) == pytest.approx(4.0, abs=1e-9)
    assert y[-1] < 0.0


def test_an_overflowing_tank_stays_at_its_brim():
    p = OVEN_TRUTH._replace(stop=10.0)
    y = respond(p, np.concatenate([np.full(200, 60.0), np.full(200, 45.0)]), 1.0)[1]
    assert np.max(y) == pytest.approx(170.0, abs=1e-9)
    assert y[-1] == pytest.approx(160.0 - 2.9 * 5.0, abs=0.2)


def test_square_root_outflow_rests_where_torricelli_says():
    # rest: K du = 2 h (sqrt(1 + v/h) - 1), so v = h ((1 + K du/(2 h))^2 - 1)
    h, du = 40.0, 8.0
    y = respond(OVEN_TRUTH._replace(head=h), np.full(800, 50.0 + du), 1.0)[1]
    assert y[-1] - 160.0 == pytest.approx(h * ((1.0 + 2.9 * du / (2.0 * h)) ** 2 - 1.0), rel=1e-5)


def test_a_rate_limited_actuator_moves_at_its_rate():
    y = respond(SERVO_TRUTH._replace(rate_limit=2.0), np.full(3000, 4.0), 0.005)[1]
    full = respond(SERVO_TRUTH, np.full(3000, 4.0), 0.005)[1]
    assert full[-1] - y[-1] == pytest.approx(50.0 * 0.5 * 4.0 * 4.0 / 2.0, rel=1e-3)  # area of the missing ramp


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.01, 2))
def test_play_never_leaves_its_output_further_than_its_half_width(du, before, width):
    out = command_static(du, before, SERVO_TRUTH._replace(backlash=width))
    assert abs(out - du) <= width + 1e-12


@given(st.floats(0.0, 0.99), st.integers(0, 4))
def test_discretisation_of_the_chain_keeps_its_static_gain(part, rows):
    chain = chain_of(OVEN_TRUTH._replace(delay=rows + part))
    s = discretise(chain, 1.0)
    gain = s.c @ np.linalg.solve(np.eye(2) - s.A, s.b_before + s.b_after)
    assert gain == pytest.approx(2.9, rel=1e-9)
    assert s.rows == rows


def test_refitting_recovers_a_chain_whose_numbers_are_wrong():
    rng = np.random.default_rng(3)
    records = []
    for _ in range(2):
        u = 50.0 + np.repeat(rng.uniform(-10, 10, 40), 30)
        records.append((u, respond(OVEN_TRUTH, u, 1.0)[1] + rng.normal(0, 0.1, len(u))))
    wrong = chain_of(OVEN_TRUTH._replace(K=2.4, tau_actuator=11.0, tau_plant=30.0, delay=2.0))
    found, rms = retune(wrong, records, 1.0, 600)
    assert pytest.approx(2.9, rel=0.005) == found.K
    assert found.tau_plant == pytest.approx(35.0, rel=0.02)
    assert rms == pytest.approx(0.1, rel=0.06)


def test_a_forecast_by_the_true_chain_errs_by_little_more_than_the_noise():
    rng = np.random.default_rng(4)
    u = np.repeat(rng.uniform(-1, 1, 60), 100)
    noise = rng.normal(0, 0.2, 6000)
    y = respond(SERVO_TRUTH, u, 0.005)[1] + noise
    e = forecast_error(chain_of(SERVO_TRUTH), u, y, 0.005, 200)
    assert 1.0 < np.std(e) / np.std(noise[400:]) < 1.06


def test_every_effect_changes_the_physics_more_at_a_greater_size():
    s = Scale(du=1.0, dy=10.0, v=20.0, length=40.0, Ts=0.005, noise=0.2, unit_u="V", unit_y="mm")
    for effect in EFFECTS:
        p = OVEN_TRUTH if PROCESS in effect.rigs else SERVO_TRUTH
        small, large = (effect.make(a, p, s, np.random.default_rng(1)) for a in (0.1, 1.0))
        assert small != large, effect.name
        assert small.parameters.keys() == large.parameters.keys() != set(), effect.name
        assert all(unit and np.isfinite(value) for value, unit in large.parameters.values()), effect.name


def test_the_list_has_every_name_that_is_fixed():
    assert {name for name in BY_NAME if not name.startswith("x.")} == {
        *(f"actuator.{e}" for e in ACTUATOR.split()),
        *(f"plant.{e}" for e in PLANT.split()),
        *(f"sensor.{e}" for e in SENSOR.split()),
        *("timing.dead_time", "timing.jitter", "timing.clock_error", "controller.law"),
        *("environment.step_load", "environment.periodic_load", "environment.drifting_load"),
    }


ACTUATOR = (
    "saturation dead_zone rate_limit backlash stiction lag asymmetric_lag nonlinear_gain offset gain_drift quantisation"
)
PLANT = (
    "coulomb_friction stribeck_friction quadratic_drag cubic_stiffness position_dependent_gain hard_stop sqrt_outflow "
    "resonance hysteresis radiation_loss leak sine_torque"
)
SENSOR = "saturation lag quantisation nonlinear_gain absolute_value drift dropout outliers"


@settings(max_examples=2)
@given(st.integers(0, 99_999))
def test_a_case_keeps_its_promises(seed):
    d, records, answer = make(seed)
    again = make(seed)[2]
    assert answer == again
    assert len(records) == 3
    assert all(len(r.y) == answer["rows"] for r in records)
    low, high = {"weak": (1.02, 1.07), "medium": (1.07, 1.26), "strong": (1.4, 3.1)}.get(answer["strength"], (0.5, 1e9))
    if d.effects and d.effects[0].name != "controller.law":
        assert low < answer["retuned_train_ratio"] < high
    if answer["sub"] in ("exact", "coloured"):
        assert answer["nominal_train_ratio"] == pytest.approx(1.0, abs=0.12)
    if answer["rig"] == SERVO:
        assert 0.8 <= answer["truth_parameters"]["K"] / d.rig.chain.K <= 1.2
    assert 0.95 < answer["nrmse_unseen"]["truth"] / answer["nrmse_unseen"]["noise"] < 1.5


def test_files_of_a_case_have_the_fixed_layout(tmp_path):
    answer = write(21, tmp_path / "case", tmp_path / "answers" / "case.json")
    assert json.loads((tmp_path / "answers" / "case.json").read_text()) == answer
    model = tomllib.loads((tmp_path / "case" / "model.toml").read_text())
    assert {block["place"] for block in model["block"]} == {"actuator", "plant", "sensor"}
    for name in ("rec1", "rec2", "unseen"):
        sidecar = tomllib.loads((tmp_path / "case" / f"{name}.toml").read_text())
        assert sidecar["sample_time"] == answer["Ts"]
        assert sidecar["controller"]["kind"]
        header, *rows = (tmp_path / "case" / f"{name}.csv").read_text().splitlines()
        assert header in ("t,u,y", "t,u,y,r")
        assert len(rows) == answer["rows"]
        t = np.array([float(row.split(",")[0]) for row in rows])
        assert t[0] == 0.0
        assert np.allclose(np.diff(t), answer["Ts"])
