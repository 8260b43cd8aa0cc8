"""Errors on stretches that a fit has not seen: what is right predicts them to within noise, what makes up does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autotune.diagnosis.evidence.stretches import STRETCHES, cuttings_in
from autotune.equations import Drive, EquationModel, compile_model, descent, fit, simulate
from autotune.equations.descent import Descent
from autotune.equations.fit_data import data_of
from autotune.equations.left_out import left_out_squares
from autotune.equations.sensitivity import run_windows
from autotune.equations.simulate import Run
from autotune.recording import Recording
from tests.autotune.equations.models import PENDULUM, model, one_state

DT, ROWS, SD = 0.05, 900, 0.01
LINEAR = one_state("b*u - a*x", {"a": 0.8, "b": 2.0})
ROOT = one_state("b*u - a*sqrt(max(x, 0))", {"a": 0.8, "b": 2.0})


def recorded(truth: EquationModel, seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.2, 1.0, ROWS // 30), 30)
    compiled = compile_model(truth)
    drive = Drive(t=DT * np.arange(ROWS), inputs=u[:, None])
    y = simulate(compiled, 1.1 * compiled.parameter_vector, drive, np.ones((1, 1))).y
    return Recording(t=drive.t, u=u, y=y + SD * rng.normal(size=ROWS))


def squares(model: EquationModel, pair: list[Recording]) -> tuple[np.ndarray, int]:
    found = fit(compile_model(model), pair, horizon_s=15.0)
    labels, *_ = cuttings_in([r.y for r in pair], [w.starts for w in found.windows], [w.stops for w in found.windows])
    return left_out_squares(found, pair, labels, STRETCHES), sum(int((label >= 0).sum()) for label in labels)


@pytest.fixture(scope="module")
def pair() -> list[Recording]:
    return [recorded(ROOT, 1), recorded(ROOT, 2)]


def test_the_true_model_leaves_the_noise_where_it_was_not_fitted(pair: list[Recording]) -> None:
    left, rows = squares(ROOT, pair)
    assert left.size == STRETCHES
    # chi-square of 1580 rows, two sd, and the few numbers that were fitted
    assert left.sum() / rows == pytest.approx(SD**2, rel=0.1)


def test_stretches_speak_for_the_true_model(pair: list[Recording]) -> None:
    assert np.sum(np.log(squares(LINEAR, pair)[0] / squares(ROOT, pair)[0])) > 12.0


def test_a_stretch_that_is_left_out_costs_the_simulations_of_its_move_alone(
    pair: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = fit(compile_model(ROOT), pair, horizon_s=15.0)
    labels = [np.arange(ROWS) // 300 for _ in pair]
    runs: list[object] = []

    def counted(*given: object, **named: object) -> Run:
        runs.append(given)
        return run_windows(*given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(descent, "run_windows", counted)
    left_out_squares(found, pair, labels, 3)
    assert len(pair) * 3 < len(runs) <= len(pair) * (1 + 2 * 3)


def test_where_moves_must_be_short_one_stretch_tells_the_next_how_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """A spring in the place of gravity: of a pendulum that swings wide derivatives foresee little."""
    rng = np.random.default_rng(1)
    u, truth = np.repeat(rng.normal(0.0, 0.8, ROWS // 25), 25), compile_model(model())
    drive = Drive(t=0.02 * np.arange(ROWS), inputs=u[:, None])
    y = simulate(truth, truth.parameter_vector, drive, np.zeros((1, 2))).y
    r = Recording(t=drive.t, u=u, y=y + 0.003 * rng.normal(size=ROWS))
    states = [PENDULUM["state"][0], {**PENDULUM["state"][1], "derivative": "(u - c*omega - k*theta)/J"}]
    numbers = {"J": {"value": 0.05}, "c": {"value": 0.02}, "k": {"value": 1.3}}
    found = fit(compile_model(model(state=states, parameters=numbers)), [r])
    labels, runs = [np.arange(ROWS) // (ROWS // 10)], []

    def counted(*given: object, **named: object) -> Run:
        runs.append(given)
        return run_windows(*given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(descent, "run_windows", counted)
    squares = left_out_squares(found, [r], labels, 10)
    monkeypatch.undo()
    alone = [left_out_squares(found, [r], [np.where(labels[0] == k, 0, -1)], 1)[0] for k in range(10)]
    assert len(runs) < 10 * 8
    assert np.log(squares) == pytest.approx(np.log(alone), abs=0.05)  # no less of any of them is unseen


def test_a_descent_on_fewer_rows_is_that_of_these_rows(pair: list[Recording]) -> None:
    compiled = compile_model(ROOT)
    data, which = [data_of(compiled, r, compiled.parameter_vector, 15.0, None) for r in pair], np.arange(2)
    fewer = [one.good & (np.arange(ROWS) >= 200) for one in data]
    own = Descent(
        compiled, [replace(one, good=good) for one, good in zip(data, fewer, strict=True)], which, np.zeros(2)
    )
    derived = Descent(compiled, data, which, np.zeros(2)).on_fewer_rows(fewer)
    for one in (own, derived):
        one.step()
    assert np.array_equal(own.fitted().z, derived.fitted().z)
    assert np.array_equal(own.simulated(), derived.simulated())


def test_what_tells_of_nothing_else_is_judged_as_unseen() -> None:
    """A load that acts in one stretch alone is not known from the others: there the retuned model misses it."""
    model = one_state("b*u - a*x + if(t >= 30, d, 0)", {"a": 0.8, "b": 2.0, "d": {"value": 0.01, "spread": 300.0}})
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(0.2, 1.0, ROWS // 30), 30)
    compiled = compile_model(model)
    drive = Drive(t=DT * np.arange(ROWS), inputs=u[:, None])
    y = simulate(compiled, np.array([0.8, 2.0, 0.3]), drive, np.ones((1, 1))).y
    r = Recording(t=drive.t, u=u, y=y + SD * rng.normal(size=ROWS))
    found = fit(compiled, [r])
    assert found.parameters[2] == pytest.approx(0.3, rel=0.05)
    label = np.where(r.t >= 30.0, 0, -1)
    left = left_out_squares(found, [r], [label], 1)
    assert left[0] / (label == 0).sum() > 10.0 * SD**2
