"""Charts and the page that carries them: what plotly.js is given, what the page weighs, that it asks for nothing."""

from __future__ import annotations

import json
import re
import shutil
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.report.chart import Chart, Scatter, log_ticks, make_subplots
from autotune.report.figures import phase_axis
from autotune.report.page import Figure, Page, Section, Table, add_line, lines_figure, write_page


def test_a_trace_lands_on_the_axes_of_its_row_and_column():
    chart = make_subplots(rows=2, cols=2, shared_xaxes=True)
    chart.add_trace(Scatter(x=[1], y=[2], line_shape="hv"), row=2, col=1)
    chart.update_yaxes(title="y [m]", row=2, col=1)
    content = json.loads(chart.to_json())
    (trace,) = content["data"]
    assert (trace["xaxis"], trace["yaxis"]) == ("x3", "y3")
    assert trace["line"] == {"shape": "hv"}
    assert content["layout"]["yaxis3"]["title"]["text"] == "y [m]"
    assert content["layout"]["xaxis"]["matches"] == "x3"


def test_rows_of_axes_fill_the_height_and_do_not_overlap():
    chart = make_subplots(rows=3, row_heights=[3, 1, 1], vertical_spacing=0.1)
    domains = [chart.layout[f"yaxis{i}"]["domain"] for i in ("", "2", "3")]
    assert domains[0][1] == pytest.approx(1.0)
    assert domains[2][0] == pytest.approx(0.0)
    assert all(above[0] - below[1] == pytest.approx(0.1) for above, below in pairwise(domains))


def test_what_is_no_number_is_null():
    chart = Chart()
    chart.add_scatter(x=np.array([0.0, np.nan]), y=np.array([np.inf, 1 / 3]))
    assert json.loads(chart.to_json())["data"][0]["y"] == [None, 0.3333333]


def page_of(tmp_path, rows=3000, *, log=False):
    t = np.linspace(0.0, 10.0, rows)
    figures = []
    for i in range(20):
        figure = lines_figure("t [s]", "y [m]", log_x=log, log_y=log)
        add_line(figure, t, np.sin(t + i), "measured", "#3b82c4")
        add_line(figure, t, np.cos(t + i), "</script>", "#d98200")
        figures.append(Figure(figure=figure, caption="<b>both</b>"))
    path = tmp_path / "page.html"
    write_page(
        Page(title="<i>T</i>", verdict="v", tone="good", sections=(Section(title="s", figures=tuple(figures)),)), path
    )
    return path


def test_a_page_of_twenty_charts_stays_within_what_a_mail_takes_and_names_nobody_else(tmp_path):
    content = page_of(tmp_path, 600).read_text(encoding="utf-8")
    assert len(content) < 1.5e6
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", content)
    assert content.count("</script>") == content.count("<script")


@pytest.mark.parametrize(
    ("drawn", "values", "texts"),
    [
        ([0.02, 0.9], [0.02, 0.05, 0.1, 0.2, 0.5], ["0.02", "0.05", "0.1", "0.2", "0.5"]),
        ([1e-9, 2e-6], [1e-9, 1e-8, 1e-7, 1e-6], [f"10<sup>−{power}</sup>" for power in (9, 8, 7, 6)]),
        ([3e5, 8e5], [5e5], ["5·10<sup>5</sup>"]),
    ],
)  # fmt: skip
def test_ticks_of_a_logarithmic_axis_are_whole_numbers(drawn, values, texts):
    """A lone 2 or 5 between decades, as plotly writes it, is tiny and says nothing of the decade."""
    ticks, numbers = log_ticks([np.array(drawn), np.array([np.nan, -1.0])])
    shown = [i for i, tick in enumerate(ticks) if min(drawn) * 0.999 <= tick <= max(drawn) * 1.001]
    assert [ticks[i] for i in shown] == pytest.approx(values)
    assert [numbers[i] for i in shown] == texts


def test_a_shared_axis_has_the_ticks_of_all_that_is_drawn_on_it():
    chart = make_subplots(rows=2, cols=1, shared_xaxes=True)
    for row, x in ((1, [0.1, 0.5]), (2, [1.0, 30.0])):
        chart.add_trace(Scatter(x=np.array(x), y=np.ones(2)), row=row, col=1)
    chart.update_xaxes(type="log")
    layout = json.loads(chart.to_json())["layout"]
    assert layout["xaxis"]["tickvals"] == layout["xaxis2"]["tickvals"]
    assert {0.1, 20.0} <= set(layout["xaxis"]["tickvals"])


@pytest.mark.system("chromium")
def test_no_number_at_a_tick_is_smaller_than_twelve_pixels(tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    path = page_of(tmp_path, 200, log=True)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for width in (1280, 400):
            opened = browser.new_page(viewport={"width": width, "height": 800})
            opened.goto(path.as_uri())
            opened.wait_for_selector("body[data-drawn=yes]")
            ticks = opened.locator(".xtick text, .ytick text")
            sizes = ticks.evaluate_all("ticks => ticks.map(one => parseFloat(getComputedStyle(one).fontSize))")
            assert len(sizes) > 100
            assert min(sizes) >= 12.0
        browser.close()


@pytest.mark.system("chromium")
def test_every_chart_is_drawn_without_a_request(tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    path, asked, wrong = page_of(tmp_path, 200), [], []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        opened = browser.new_page(viewport={"width": 400, "height": 800})
        opened.on("request", lambda request: asked.append(request.url))
        opened.on("pageerror", lambda error: wrong.append(str(error)))
        opened.goto(path.as_uri())
        opened.wait_for_selector("body[data-drawn=yes]")
        assert opened.locator(".chart .main-svg").count() >= 20
        assert opened.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
        opened.locator(".legend button").first.click()
        assert opened.locator(".chart").first.evaluate("chart => chart.data[0].visible") is False
        browser.close()
    assert wrong == []
    assert [url for url in asked if not url.startswith(("file:", "blob:", "data:"))] == []


@pytest.mark.system("chromium")
def test_a_long_table_is_sorted_by_its_numbers_and_filtered_by_words(tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    rows = tuple((f"LIC{i:03d}", f"{10.0 ** (i % 5 - 2):g}", "oven" if i % 3 else "tank") for i in range(30))
    table = Table(header=("loop", "K", "area"), rows=(*rows, ("LIC999", "not designed", "tank")))
    path, wrong = tmp_path / "page.html", []
    write_page(Page(title="t", verdict="v", tone="good", sections=(Section(title="s", tables=(table,)),)), path)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        opened = browser.new_page()
        opened.on("pageerror", lambda error: wrong.append(str(error)))
        opened.goto(path.as_uri())
        opened.get_by_role("button", name="K").click()
        shown = opened.locator("tbody tr td:nth-child(2)").all_text_contents()
        assert [float(one) for one in shown[:-1]] == sorted(float(one) for one in shown[:-1])
        assert shown[-1] == "not designed"
        opened.get_by_role("button", name="K").click()
        assert opened.locator("tbody tr td:nth-child(2)").all_text_contents()[1] == "100"
        opened.get_by_role("searchbox").fill("tank lic0")
        assert opened.locator("tbody tr:visible").count() == 10
        browser.close()
    assert wrong == []


@given(delay_deg=st.floats(0.0, 20000.0), lowest=st.floats(-400.0, -5.0))
def test_a_phase_axis_has_few_ticks_and_shows_every_point_however_far_dead_time_turns(delay_deg, lowest):
    points = np.linspace(-5.0, lowest, 7)
    low, high, step = phase_axis([points], [np.linspace(-1.0, -1.0 - delay_deg, 50)])
    assert low <= points.min()
    assert high >= points.max()
    assert (high - low) / step <= 9
