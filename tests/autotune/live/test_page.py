from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import tomli_w
from playwright.sync_api import Browser, Page, expect, sync_playwright

from autotune.cli.common import rig_of
from autotune.cli.served import device_of
from autotune.config import load_config
from autotune.experiment.rig import HoldsGains
from autotune.live.session import LivePage
from autotune.pipeline import tune
from autotune.pipeline.deployment import read_gains
from autotune.recording import read_recording
from sim.modbus_rig import ModbusRig, TcpTransport
from tests.autotune.experiment.rigs import ball_config, ball_rig

pytestmark = pytest.mark.system("chromium")

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
#: no wait of a test is longer [ms]
LIMIT_MS = 60_000
#: the pixels of a chart, and of all charts
PIXELS = "() => [...document.querySelectorAll('canvas')].map(one => one.toDataURL()).join()"
CONTRAST = """selector => {
  const channels = text => text.match(/[\\d.]+/g).map(Number);
  const linear = c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
  const light = text => channels(text).slice(0, 3).map(c => linear(c / 255))
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const element = document.querySelector(selector);
  let behind = element;
  while (channels(getComputedStyle(behind).backgroundColor)[3] === 0) behind = behind.parentElement;
  const pair = [light(getComputedStyle(element).color), light(getComputedStyle(behind).backgroundColor)];
  return (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05);
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as driver:
        options = ["--no-sandbox"] if os.geteuid() == 0 else []
        opened = driver.chromium.launch(executable_path=shutil.which("chromium"), args=options)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of the simulated ball that waited for the operator's decision."""
    out = tmp_path_factory.mktemp("whole")
    tune(ball_rig(), ball_config(), out, keep=lambda patience_s: True)
    return out


class Growing:
    """A folder that fills as that of a run does, from the files of one that has ended."""

    def __init__(self, whole: Path, folder: Path) -> None:
        self.folder = folder
        self._whole = whole
        self._events = (whole / "progress.jsonl").read_text().splitlines()

    def until(self, word: str, rows: int) -> None:
        """Let it grow up to the first event that contains the word, and so many rows of the first recording."""
        last = next(i for i, line in enumerate(self._events) if word in line)
        (self.folder / "progress.jsonl").write_text("\n".join(self._events[: last + 1]) + "\n")
        lines = (self._whole / "recording.csv").read_text().splitlines(keepends=True)
        (self.folder / "recording.csv").write_text("".join(lines[:rows]))


@pytest.fixture
def growing(whole: Path, tmp_path: Path) -> Growing:
    folder = Growing(whole, tmp_path)
    folder.until("limit cycle 2 of 3", 2000)
    return folder


@pytest.fixture
def beside(growing: Growing) -> Iterator[LivePage]:
    """The page of a run that goes on; ask for it before ``opened``, whose pages it waits for."""
    with LivePage(growing.folder, "127.0.0.1", 0, None) as page:
        yield page


@pytest.fixture(scope="module")
def deciding(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LivePage]:
    """The page of a run that waits for the operator's decision."""
    folder = Growing(whole, tmp_path_factory.mktemp("deciding"))
    folder.until('"waiting"', 6000)
    with LivePage(folder.folder, "127.0.0.1", 0, None) as page:
        yield page


@pytest.fixture
def opened(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Opens pages and closes them at the end; ``asked`` collects what they ask for."""
    with ExitStack() as stack:

        def open_page(url: str, asked: list[str] | None = None, **options: object) -> Page:
            context = browser.new_context(**options)  # type: ignore[arg-type]
            stack.callback(context.close)
            page = context.new_page()
            page.set_default_timeout(LIMIT_MS)
            if asked is not None:
                page.on("request", lambda request: asked.append(request.url))
                page.on("websocket", lambda socket: asked.append(socket.url))
            page.goto(url)
            expect(page.locator("canvas").first).to_be_visible(timeout=LIMIT_MS)
            return page

        yield open_page


def test_the_picture_follows_the_data_and_nothing_is_asked_of_another_machine(
    beside: LivePage, opened: Callable[..., Page], growing: Growing
) -> None:
    asked: list[str] = []
    page = opened(beside.url, asked)
    expect(page.get_by_role("status")).to_have_text(re.compile("limit cycle 2 of 3"), timeout=LIMIT_MS)
    seen = set()
    for word, rows in (("limit cycle 2 of 3", 2500), ("limit cycle 3 of 3", 2500), ("all points measured", 6000)):
        page.wait_for_function(f"seen => ({PIXELS})().length > 20000 && !seen.includes(({PIXELS})())", arg=list(seen))
        seen.add(page.evaluate(PIXELS))
        growing.until(word, rows)
        expect(page.get_by_role("status")).to_have_text(re.compile(word), timeout=LIMIT_MS)
    page.wait_for_function(f"seen => !seen.includes(({PIXELS})())", arg=list(seen))
    assert len(asked) > 5
    assert {urlsplit(url).netloc for url in asked if not url.startswith("data:")} == {urlsplit(beside.url).netloc}


def test_light_or_dark_narrow_or_wide_everything_can_be_read(opened: Callable[..., Page], deciding: LivePage) -> None:
    pictures = set()
    for width, scheme in ((400, "light"), (400, "dark"), (1920, "light"), (1920, "dark")):
        page = opened(deciding.url, viewport={"width": width, "height": 1000}, color_scheme=scheme)
        expect(page.locator(".outcome")).to_be_visible(timeout=LIMIT_MS)
        page.wait_for_function(f"({PIXELS})().length > 20000")
        pictures.add(page.evaluate(PIXELS))
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
        for selector in ("h1", "[role=status]", ".left", ".note", ".gains", "body"):
            assert page.evaluate(CONTRAST, selector) >= 4.5, f"{selector} at {width} px, {scheme}"
        page.context.close()
    assert len(pictures) == 4


def test_by_keyboard_alone_the_old_gains_are_asked_back(opened: Callable[..., Page], deciding: LivePage) -> None:
    page = opened(deciding.url)
    expect(page.locator(".left")).to_have_text(re.compile(r"^\d+ s left to decide"), timeout=LIMIT_MS)
    take, restore = (page.get_by_role("button", name=name) for name in ("Take the controls", "Restore old gains"))
    expect(page.locator("header .note")).to_have_text(re.compile("holds the controls"), timeout=LIMIT_MS)
    if take.is_visible():  # the page of another test had them
        take.press("Enter")
    expect(restore).to_be_enabled(timeout=LIMIT_MS)
    for _ in range(12):
        page.keyboard.press("Tab")
        if restore.evaluate("one => one === document.activeElement"):
            break
    page.keyboard.press("Enter")
    assert not deciding.keep(LIMIT_MS / 1000)


def test_gains_that_are_not_wanted_are_taken_back_from_the_rig(opened: Callable[..., Page], tmp_path: Path) -> None:
    config = ball_config(signals={"sample_time_s": 0.03}, experiment={"points": 3, "budget_s": 25.0})
    rig = rig_of(config)
    assert isinstance(rig, HoldsGains)
    with LivePage(tmp_path, "127.0.0.1", 0, None) as live, ThreadPoolExecutor(1) as worker:
        run = worker.submit(tune, rig, config, tmp_path, keep=live.keep)
        with closing(opened(live.url).context) as context:
            (page,) = context.pages
            page.get_by_role("button", name="Restore old gains").click(timeout=LIMIT_MS)
            expect(page.locator(".outcome")).to_contain_text("The simulated rig holds the old gains.", timeout=LIMIT_MS)
        tuning = run.result()
    assert tuning.verification is not None
    assert tuning.verification.accepted
    assert not tuning.deployed
    assert rig.read_gains() == tuning.old_controller


@pytest.mark.slow
@pytest.mark.parametrize(
    ("choice", "held"), [("Keep new gains", "new"), ("Restore old gains", "old")], ids=["keep", "restore"]
)
def test_a_whole_run_on_a_rig_process_is_followed_and_decided_in_the_browser(
    opened: Callable[..., Page], tmp_path: Path, choice: str, held: str
) -> None:
    content = load_config(CONFIGS / "ball_modbus_tcp.toml").model_dump(exclude_none=True)
    content |= {"verification": {"duration_s": 8.0}}
    content["experiment"] |= {"points": 3, "budget_s": 25.0}
    with socket.create_server(("127.0.0.1", 0)) as free:
        content["rig"]["port"] = free.getsockname()[1]
    file, out = tmp_path / "ball.toml", tmp_path / "out"
    file.write_text(tomli_w.dumps(content))
    with ExitStack() as stack:

        def started(priority: str, *words: str) -> subprocess.Popen[str]:
            # 100 Hz beside a browser that draws: rig and loop go first where they may
            first = ["chrt", priority, "10"] if os.geteuid() == 0 else []
            command = [*first, sys.executable, "-u", "-m", "autotune.cli", *words]
            child = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            stack.callback(child.send_signal, signal.SIGINT)
            return child

        serving = started("-r", "rig", str(file))
        assert serving.stdout is not None
        assert any("serving" in line for line in serving.stdout)
        run = started("-Rr", "run", str(file), "--out", str(out), "--live")
        assert run.stdout is not None
        page = opened(run.stdout.readline().split()[-1])
        status, plane, ellipses = page.get_by_role("status"), "document.querySelector('.plane canvas').toDataURL()", []
        for number in (1, 2, 3):
            expect(status).to_have_text(re.compile(f"limit cycle {number} of 3"), timeout=LIMIT_MS)
            page.wait_for_function(f"seen => !seen.includes({plane})", arg=ellipses)
            ellipses.append(page.evaluate(plane))
        expect(status).to_have_text(re.compile("new gains. Keep them"), timeout=2 * LIMIT_MS)
        expect(page.locator(".gains")).to_have_text(re.compile(r"-0\.01\s*-0\.02"))
        page.wait_for_function("document.querySelector('.steps canvas').toDataURL().length > 20000")
        page.get_by_role("button", name=choice).click()
        expect(status).to_have_text(re.compile("^Ended: completed"), timeout=LIMIT_MS)
        expect(page.locator(".outcome")).to_contain_text(f"The rig holds the {held} gains.")
        page.context.close()
        assert run.wait() == 0
        rig = rig_of(load_config(file))
        assert isinstance(rig, HoldsGains)
        gains = read_gains(rig)
    new = json.loads((out / "result.json").read_text())["controller"]
    wanted = (new["K"], new["Ti_s"]) if held == "new" else (-0.01, 6.0)
    assert (gains.K, gains.Ti_s) == pytest.approx(wanted, rel=1e-3)


def test_one_page_holds_the_controls_through_a_reload_and_another_takes_them_when_it_is_closed(
    beside: LivePage, opened: Callable[..., Page]
) -> None:
    first = opened(beside.url)
    abort = first.get_by_role("button", name="Abort")
    expect(abort).to_be_visible(timeout=LIMIT_MS)
    first.keyboard.press("Tab")
    expect(abort).to_be_focused()
    second = opened(beside.url)
    expect(second.get_by_text("Another page holds the controls")).to_be_visible(timeout=LIMIT_MS)
    expect(second.get_by_role("button", name="Abort")).to_be_hidden()
    first.reload()
    expect(abort).to_be_visible(timeout=LIMIT_MS)
    first.context.close()
    second.get_by_role("button", name="Take the controls").click()
    expect(second.get_by_role("button", name="Abort")).to_be_visible(timeout=LIMIT_MS)
    beside.process.kill()
    assert beside.keep(LIMIT_MS / 1000)  # without a page the automatic decision stands


def test_abort_brings_the_rig_to_its_safe_output_within_one_control_period(
    opened: Callable[..., Page], tmp_path: Path
) -> None:
    tanks = load_config(CONFIGS / "two_tank_sim.toml").model_dump(exclude_none=True)
    modbus = load_config(CONFIGS / "ball_modbus_tcp.toml").model_dump(exclude_none=True)["rig"]
    twin = {"plant": "two_tank", "start": "level", "deadman_s": 30.0}
    content = tanks | {"rig": modbus | {"twin": twin}, "name": "tanks behind Modbus"}
    file = tmp_path / "tanks.toml"
    file.write_text(tomli_w.dumps(content))
    device = device_of(load_config(file))
    held = device.output  # at rest at the operating point, where nothing has to move
    with ModbusRig(device, TcpTransport()) as server:
        content["rig"]["port"] = server.port
        file.write_text(tomli_w.dumps(content))
        command = ["run", str(file), "--out", str(tmp_path / "out"), "--live"]
        with subprocess.Popen(
            [sys.executable, "-m", "autotune.cli", *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as run:
            assert run.stdout is not None
            address = run.stdout.readline().split()[-1]
            try:
                page = opened(address)
                expect(page.get_by_role("button", name="Abort")).to_be_visible(timeout=LIMIT_MS)
                page.wait_for_function("document.querySelector('.left').innerText.match(/^[2-9]/)")
                assert device.output == pytest.approx(held, abs=0.1)
                assert held > 2.0
                before = len(read_recording(tmp_path / "out" / "recording.csv"))
                page.keyboard.press("Escape")
                expect(page.get_by_role("status")).to_have_text(
                    re.compile("^Ended: preflight: stopped by Abort on the live page; .*the rig has its safe output"),
                    timeout=LIMIT_MS,
                )
                page.context.close()
            except BaseException:
                run.kill()
                raise
            _, errors = run.communicate()
    recording = read_recording(tmp_path / "out" / "recording.csv")
    # at most the period that Abort was pressed in, one more that began while it was on its way, and the safe command
    assert len(recording) - before <= 3
    assert recording.u[-1] == device.output == 0.0
    assert [change.cause for change in device.history][-1] != "dead-man"
    assert run.returncode == 130
    assert "stopped by Abort on the live page" in errors
    assert "stopped by Abort on the live page" in recording.metadata["ended"]["reason"]
    ended = json.loads((tmp_path / "out" / "progress.jsonl").read_text().splitlines()[-1])
    assert ended["exit_status"] == 130
