"""What the first rows of a recording foretell of the last ones, and what a page says of it."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from scipy.signal import lfilter

from autotune.config.procedure import SignalSettings
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction
from autotune.recording import Recording
from autotune.report.free_run import forecast
from autotune.report.plant_section import model_figures
from autotune.report.tuned_page import origin_text

NOISE = 0.1


def oven(gain_of_the_last_third: float = 0.8) -> Recording:
    """Return a record of 0.8/(30 s + 1) with 4 s of dead time under steps, 900 rows of a second."""
    rng = np.random.default_rng(3)
    u = np.repeat([0.0, 10.0, -5.0, 5.0, 0.0, 10.0, -5.0, 5.0, 0.0], 100)
    gain = np.where(np.arange(u.size) < 600, 0.8, gain_of_the_last_third)
    late = np.concatenate([np.zeros(5), u[:-5]])
    pole = np.exp(-1.0 / 30.0)
    y = 50.0 + lfilter([1.0 - pole], [1.0, -pole], gain * late) + NOISE * rng.standard_normal(u.size)
    return Recording(t=np.arange(float(u.size)), u=u, y=y, name="oven.csv")


@pytest.fixture
def fit() -> PlantFit:
    plant = TransferFunction(num=(0.8,), den=(30.0, 1.0), delay_s=4.0)
    return PlantFit(
        plant=plant, integrating=False, parameters=np.zeros(3), covariance=np.zeros((3, 3)), sign=1, chi_square=0.0,
        degrees_of_freedom=0, bounds=np.zeros((2, 3)), build=lambda _: plant, source="recording",
    )  # fmt: skip


def test_unseen_rows_of_a_plant_that_stays_are_missed_by_the_noise(fit: PlantFit) -> None:
    found = forecast(fit, oven())
    assert found is not None
    assert found.first == 600
    assert found.seen == pytest.approx(NOISE, rel=0.1)
    assert found.unseen == pytest.approx(NOISE, rel=0.15)


def test_a_plant_that_changes_is_missed_by_more_than_the_rows_it_was_fitted_to(fit: PlantFit) -> None:
    found = forecast(fit, oven(gain_of_the_last_third=1.0))
    assert found is not None
    assert found.unseen > 5.0 * found.seen


def test_no_unseen_row_has_a_part_in_its_forecast(fit: PlantFit) -> None:
    record = oven()
    y = record.y.copy()
    y[600:] = np.random.default_rng(0).uniform(0.0, 100.0, 300)
    one, other = forecast(fit, record), forecast(fit, replace(record, y=y))
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.y, other.y)


def test_the_caption_says_how_far_the_unseen_rows_are_missed(fit: PlantFit) -> None:
    (figure,) = model_figures(fit, (oven(),), SignalSettings(sample_time_s=1.0, u_unit="%", y_unit="degC"))
    assert "misses the last third by 0." in figure.caption
    assert "forecast of unseen rows" in [trace.get("name") for trace in figure.figure.data]


def test_rows_that_do_not_determine_the_plant_foretell_nothing(fit: PlantFit) -> None:
    record = oven()
    assert forecast(fit, replace(record, u=np.where(record.t < 600.0, 0.0, 1.0))) is None


def test_a_page_says_which_columns_of_which_file_it_rests_on_and_when_it_was_made() -> None:
    record = replace(oven(), metadata={"file": {"columns": {"t": "Zeit", "u": "Ventil [%]", "y": "Istwert"}}})
    first, last = origin_text([record], datetime(2026, 3, 1, 8, 5, tzinfo=UTC))
    assert first == "From oven.csv: t = Zeit, u = Ventil [%], y = Istwert; 900 rows over 900 s, 1 s apart."
    assert last.startswith("Made by relay-autotune ")
    assert last.endswith("on 2026-03-01 at 08:05 UTC.")


def test_a_set_point_is_among_the_columns_that_a_page_rests_on() -> None:
    record = oven()
    with_setpoint = replace(record, extra={"r": np.full(len(record), 50.0)})
    assert "columns t, u, y;" in origin_text([record], None)[0]
    assert "columns t, u, y, r;" in origin_text([with_setpoint], None)[0]
