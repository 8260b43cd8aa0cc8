"""What the rivals' table compares: the same rows, the same gap; and that rivals can do what they are there for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.model_tables import read_model
from tests.benchmarks._rival_cases import Case
from tests.benchmarks._rival_forecasts import gaussian_process, narx, nrmse, windows
from tests.benchmarks._rival_sindy import sindy
from tests.sim.recorded_rig import MODEL, NOISE, TS, record, write_recording, write_rig


def case(folder, **said):
    """A case of the rig that the tests of recorded rigs have."""
    return Case(
        name="servo", model=folder / "model.toml", given=(folder / "fit.csv",), kept_back=(folder / "test.csv",),
        **{"horizon_s": 2.0, "score_from_s": 4.0, "right": frozenset(), **said},
    )  # fmt: skip


@given(st.integers(50, 400), st.floats(0.1, 3.0), st.floats(0.0, 2.0))
def test_every_row_that_is_judged_is_forecast_once(rows, horizon_s, score_from_s):
    t = 5.0 + np.arange(rows) * 0.1
    covered = np.concatenate([np.arange(a, b) for a, b in windows(t, horizon_s, score_from_s)])
    assert np.array_equal(covered, np.flatnonzero(t - 5.0 >= score_from_s - 1e-9))


def test_the_gap_is_0_at_the_linear_model_1_at_the_best_one_and_never_below_minus_1(tmp_path):
    one = case(tmp_path, linear=0.5, best=0.1)
    assert [one.gap(error) for error in (0.5, 0.1, 0.3, 9.0, np.inf)] == pytest.approx([0.0, 1.0, 0.5, -1.0, -1.0])


def test_a_name_is_false_unless_it_is_right_or_tolerated(tmp_path):
    one = case(tmp_path, right=frozenset({"plant.leak"}), tolerated=frozenset({"actuator.offset"}))
    assert not one.false(["plant.leak", "actuator.offset"])
    assert one.false(["plant.leak", "sensor.lag"])
    assert not one.false([])


@pytest.mark.filterwarnings("ignore::UserWarning")  # scikit-learn's, of a length scale at its bound
@pytest.mark.parametrize("rival", [narx, gaussian_process])
def test_a_forecaster_without_physics_comes_near_the_noise_of_a_linear_plant(tmp_path, rival):
    pytest.importorskip("sklearn")
    write_rig(tmp_path)
    r = tuple(column[:1501] for column in record(2, 1550))  # no whole number of the forecaster's steps
    write_recording(tmp_path / "test.csv", *r)
    error = rival(case(tmp_path), read_model(tmp_path / "model.toml"))
    perfect = nrmse(r[0], r[2], r[2] + np.random.default_rng(0).normal(0.0, NOISE, len(r[0])), 4.0)
    assert error < 3.0 * perfect


def test_a_sparse_regression_names_drag_where_there_is_plain_drag(tmp_path):
    pytest.importorskip("pysindy")
    (tmp_path / "model.toml").write_text(MODEL.replace("[0.05, 1.0]", "[1.0]"))
    for name, seed in (("fit", 1), ("test", 2)):
        t, u, _ = record(seed, 3000)
        v, y = 0.0, []
        for command in u:
            y.append(1.0 + v)
            for _ in range(20):  # 0.3 v' = 2 u - v - 0.8 |v| v
                v += TS / 20 * (2.0 * (command - 0.5) - v - 0.8 * abs(v) * v) / 0.3
        write_recording(tmp_path / f"{name}.csv", t, u, np.array(y))
    names, error = sindy(case(tmp_path), read_model(tmp_path / "model.toml"))
    assert names == ("plant.quadratic_drag",)
    assert error < 0.1
