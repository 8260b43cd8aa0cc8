"""The watched loop: parameters over time, their bands, the advice, and the commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autotune.cli import app
from autotune.controller import PIDController, write_controller
from autotune.errors import InputError
from autotune.identification.delay.identify import identify_delay
from autotune.identification.delay.tracking import quantities, track
from autotune.recording import Recording, write_recording
from autotune.watch import advise


def loop_in_operation(seed: int = 0, delay_after: float = 0.4) -> Recording:
    """A PI loop around 2 exp(-0.4 s)/((1 + 2 s)(1 + 0.5 s)) under set-point changes; the dead time moves at 150 s."""
    from scipy.signal import cont2discrete, tf2ss

    dt = 0.02
    rng = np.random.default_rng(seed)
    A, B, C, _, _ = cont2discrete(tf2ss([2.0], np.polymul([2.0, 1.0], [0.5, 1.0])), dt)
    t = np.arange(15000) * dt
    r = np.repeat(rng.uniform(-1.0, 1.0, t.size // 250), 250)
    u, y, x, integral = np.zeros(t.size), np.zeros(t.size), np.zeros(2), 0.0
    for k in range(t.size):
        y[k] = float((C @ x)[0]) + 0.01 * rng.standard_normal()
        e = r[k] - y[k]
        integral += dt * e
        u[k] = 0.8 * (e + integral / 2.2)
        lag = round((0.4 if t[k] < 150.0 else delay_after) / dt)
        x = A @ x + B[:, 0] * (u[k - lag] if k >= lag else 0.0)
    return Recording(t=t, u=u + 4.0, y=y + 10.0, name="loop")


DEPLOYED = PIDController(K=0.8, Ti_s=2.2)


@pytest.fixture(scope="module")
def drifting() -> Recording:
    return loop_in_operation(delay_after=1.2)


def test_windows_follow_a_dead_time_that_moves_in_closed_loop(drifting):
    fits = list(track(drifting, 2, window_s=60.0, every_s=30.0, max_delay_s=5.0))
    models = {fit.end_s: fit.model for fit in fits}
    for end_s, delay_s in ((60.0, 0.4), (120.0, 0.4), (240.0, 1.2), (270.0, 1.2)):
        model = models[end_s]
        assert model is not None
        found = {q.name: q for q in quantities(model)}
        truth = {"gain": 2.0, "dead time": delay_s, "time constant 1": 2.0, "time constant 2": 0.5}
        for name, value in truth.items():
            assert abs(found[name].value - value) < 5.0 * found[name].sd
            assert found[name].sd < 0.1 * value


def test_advice_changes_with_the_plant(drifting):
    before = identify_delay(drifting.between(0.0, 140.0), 2, max_delay_s=5.0)
    after = identify_delay(drifting.between(160.0, 300.0), 2, max_delay_s=5.0)
    required = {"modulus_margin": 0.5, "phase_margin_rad": np.pi / 4}
    assert advise(before, DEPLOYED, **required).verdict == "keep"
    assert advise(after, DEPLOYED, **required).verdict == "retune"
    assert advise(before, PIDController(K=-0.8, Ti_s=2.2), **required).verdict == "retune"  # unstable: wrong sign


def test_bands_cover_the_truth():
    """95 % intervals of gain, dead time and time constants over loops with their own noise and set-points."""
    truth = np.array([2.0, 0.4, 2.0, 0.5])
    inside = []
    for seed in range(20):
        record = loop_in_operation(seed).between(0.0, 60.0)
        found = quantities(identify_delay(record, 2, max_delay_s=3.0))
        value, sd = np.array([q.value for q in found]), np.array([q.sd for q in found])
        inside.append(np.abs(value - truth) < 1.96 * sd)
    assert np.mean(inside) > 0.86


def test_an_unexcited_window_is_reported_with_its_reason():
    record = loop_in_operation()
    still = Recording(t=record.t, u=np.where(record.t > 100.0, 4.0, record.u), y=record.y)
    fits = list(track(still, 2, window_s=40.0, every_s=40.0, max_delay_s=5.0))
    assert fits[0].model is not None
    assert fits[-1].model is None
    assert "constant" in fits[-1].reason


def test_lost_samples_cost_nothing_but_themselves():
    """One y in ten is lost, u being known: the window is determined as well as a tenth fewer rows allow."""
    record = loop_in_operation().between(0.0, 80.0)
    lost = np.random.default_rng(1).random(len(record)) < 0.1
    holed = replace(record, y=np.where(lost, np.nan, record.y))
    whole, fitted = (next(track(r, 2, window_s=60.0, every_s=60.0, max_delay_s=5.0)).model for r in (record, holed))
    assert whole is not None
    assert fitted is not None
    assert np.all(np.abs(fitted.values[:4] - whole.values[:4]) < 2.0 * whole.standard_deviations[:4])
    assert np.allclose(fitted.standard_deviations[:4], whole.standard_deviations[:4] / np.sqrt(0.9), rtol=0.1)


def test_the_way_to_the_operating_point_is_not_tracked(tmp_path):
    """Before the first set-point the plant rests on a stop, whatever u does: that is not the loop."""
    record = loop_in_operation().between(0.0, 90.0)
    approach = record.t < 30.0
    written = replace(
        record,
        u=np.where(approach, record.t / 10.0, record.u),
        y=np.where(approach, 0.0, record.y),
        extra={"r": np.where(approach, np.nan, 10.0)},
    )
    write_recording(written, tmp_path / "loop.csv")
    watched = CliRunner().invoke(
        app,
        ["watch", str(tmp_path / "loop.csv"), "--window", "50", "--max-delay", "3", "--out", str(tmp_path / "w.csv")],
    )
    assert watched.exit_code == 0, watched.output
    header, first = (tmp_path / "w.csv").read_text().splitlines()[:2]
    found = dict(zip(header.split(","), map(float, first.split(",")), strict=True))
    assert found["t"] == pytest.approx(80.0, abs=0.1)
    assert abs(found["dead_time"] - 0.4) < 5.0 * found["dead_time_sd"]


def test_a_reason_that_stays_the_same_is_said_once(tmp_path):
    """A plant at rest under a command that does not move tells nothing in any window."""
    y = np.random.default_rng(1).standard_normal(400)
    write_recording(Recording(t=np.arange(400.0), u=np.full(400, 5.0), y=y, name="rest"), tmp_path / "rest.csv")
    command = ["watch", str(tmp_path / "rest.csv"), "--window", "100", "--out", str(tmp_path / "w.csv")]
    watched = CliRunner().invoke(app, command)
    assert watched.exit_code == 0, watched.output
    first, *others = [line for line in watched.output.splitlines() if "not determined" in line]
    assert not first.endswith("as before")
    assert len(others) > 3
    assert all(line.endswith("not determined, as before") for line in others)


@pytest.mark.parametrize(
    ("num", "den", "said", "wanted"),
    [
        ([0.8], [9.0, 1.0], "a plant of order 1", {"gain": 0.8, "time_constant_1": 9.0}),
        ([-65.5], [0.36, 1.0, 0.0], "an integrating plant of order 2", {"gain": -65.5, "time_constant_1": 0.36}),
    ],
    ids=["one lag", "a ball"],
)
def test_what_the_windows_determine_is_tracked_where_no_order_is_given(tmp_path, num, den, said, wanted):
    """Of a single lag no window determines order 2; of an integrator the gain at rest has no end."""
    from scipy.signal import lsim

    slowest = den[0]
    t = np.arange(2000) * 0.02 * slowest
    rng = np.random.default_rng(3)
    u = np.repeat(rng.permutation(np.tile([-1.0, 1.0], 50)), 20)
    y = lsim((num, den), u, t, interp=False)[1] + 1e-3 * abs(num[0]) * slowest * rng.standard_normal(t.size)
    write_recording(Recording(t=t, u=u + 5.0, y=y + 5.0), tmp_path / "rec.csv")
    watched = CliRunner().invoke(app, ["watch", str(tmp_path / "rec.csv"), "--out", str(tmp_path / "w.csv")])
    assert watched.exit_code == 0, watched.output
    assert said in watched.output
    header, *rows = (tmp_path / "w.csv").read_text().splitlines()
    table = np.genfromtxt(rows, delimiter=",", names=header.split(","))
    assert len(table) >= 10
    for name, value in wanted.items():
        assert np.mean(np.abs(table[name] - value) < 1.96 * table[name + "_sd"]) > 0.75
        assert table[name] == pytest.approx(np.full(len(table), value), rel=0.1)


def test_a_window_longer_than_the_record_is_refused():
    with pytest.raises(InputError, match="window 1000 s"):
        next(track(loop_in_operation(), 2, window_s=1000.0, every_s=10.0))


def test_commands_on_files(tmp_path, drifting):
    write_recording(drifting, tmp_path / "loop.csv")
    write_controller(DEPLOYED, tmp_path / "pi.toml")
    runner = CliRunner()
    watched = runner.invoke(
        app,
        ["watch", str(tmp_path / "loop.csv"), "--controller", str(tmp_path / "pi.toml"), "--window", "60",
         "--every", "60", "--max-delay", "5", "--out", str(tmp_path / "watch.csv")],
    )  # fmt: skip
    assert watched.exit_code == 0, watched.output
    assert "retune: " in watched.output
    table = (tmp_path / "watch.csv").read_text().splitlines()
    assert table[0].startswith("t,gain,gain_sd,dead_time,dead_time_sd,time_constant_1")
    assert table[1].endswith("keep")
    assert table[-1].endswith("retune")
    identified = runner.invoke(
        app, ["identify", "delay", str(tmp_path / "loop.csv"), "--order", "2", "--start", "170", "--max-delay", "5",
              "--out", str(tmp_path / "delay.json")],
    )  # fmt: skip
    assert identified.exit_code == 0, identified.output
    content = json.loads((tmp_path / "delay.json").read_text())
    assert set(content) >= {"order", "a", "b", "delay_s", "initial_state", "sd"}
    assert set(content["sd"]) == {"a", "b", "delay_s"}
    assert content["delay_s"] == pytest.approx(1.2, abs=0.05)
    assert len(content["a"]) == len(content["initial_state"]) == content["order"] == 2


def test_a_rig_is_watched_while_its_present_loop_runs(tmp_path):
    """The servo is 2/(s (1 + 0.08 s)) with a hold of 2 ms; fits run in a process of their own."""
    config = Path(__file__).resolve().parents[3] / "configs" / "servo_sim.toml"
    out = tmp_path / "watched"
    command = ["watch", str(config), "--integrator", "--duration", "12", "--window", "6", "--max-delay", "0.2"]
    watched = CliRunner().invoke(app, [*command, "--out", str(out)])
    assert watched.exit_code == 0, watched.output
    header, *rows = (out / "watch.csv").read_text().splitlines()
    last = dict(zip(header.split(","), rows[-1].split(","), strict=True))
    assert float(last["gain"]) == pytest.approx(2.0, rel=0.02)
    assert float(last["time_constant_1"]) == pytest.approx(0.08, rel=0.05)
    assert last["verdict"] == "keep"
    assert (out / "recording.csv").is_file()


def drifting_loop(seed: int, delay_rate: float, gain_rate: float) -> Recording:
    """The loop of the others with a dead time or a gain that moves all the time, and set-points far apart or near."""
    from scipy.signal import cont2discrete, tf2ss

    dt, rng = 0.02, np.random.default_rng(seed)
    A, B, C, _, _ = cont2discrete(tf2ss([1.0], np.polymul([2.0, 1.0], [0.5, 1.0])), dt)
    t = np.arange(6000) * dt
    r = np.repeat(rng.uniform(-1.0, 1.0, 24), 250 if seed % 2 else 700)[: t.size]
    u, y, x, integral = np.zeros(t.size), np.zeros(t.size), np.zeros(2), 0.0
    for k in range(t.size):
        y[k] = float((C @ x)[0]) + 0.01 * rng.standard_normal()
        e = r[k] - y[k]
        integral += dt * e
        u[k] = 0.8 * (e + integral / 2.2)
        late = np.interp(t[k] - (0.4 + delay_rate * t[k]), t[: k + 1], u[: k + 1], left=0.0)
        x = A @ x + B[:, 0] * (2.0 + gain_rate * t[k]) * late
    return Recording(t=t, u=u + 4.0, y=y + 10.0, name="drifting loop")


def test_a_parameter_that_moves_within_a_window_has_its_mean_inside_the_interval():
    """Where the set-point moved tells more about then than about the window's mean; constants alone miss it."""
    misses = []
    for seed, (delay_rate, gain_rate) in enumerate([(0.004, 0.0), (0.004, 0.0), (0.0, 0.006), (0.0, 0.006)]):
        for fit in track(drifting_loop(seed, delay_rate, gain_rate), 2, window_s=60.0, every_s=30.0, max_delay_s=5.0):
            if fit.model is None:
                continue
            middle = fit.end_s - 30.0
            found = {q.name: q for q in quantities(fit.model)}
            for name, truth in {"dead time": 0.4 + delay_rate * middle, "gain": 2.0 + gain_rate * middle}.items():
                misses.append((found[name].value - truth) / found[name].sd)
    assert len(misses) >= 12
    assert np.mean(np.abs(misses) < 1.96) >= 0.9
    assert np.sqrt(np.mean(np.square(misses))) < 1.3
