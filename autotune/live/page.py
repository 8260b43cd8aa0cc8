"""The page itself: state, warnings, charts, controls and outcome; it shows a story and never touches the run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from nicegui import Client, ui
from nicegui.elements.mixins.text_element import TextElement
from nicegui.events import KeyEventArguments

from autotune.controller import PIDController
from autotune.experiment.leaving import sentence
from autotune.live.charts import Pictures
from autotune.live.controls import Controls
from autotune.live.story import Story
from autotune.report.figures import ratio_title

#: what the strip chart shows [s]
SPANS = {20.0: "20 s", 60.0: "60 s", math.inf: "All"}
#: shortest time between two pictures [s]
PICTURE_S = 0.4
#: longest wait for a browser to say that it has drawn before it is sent the next picture [s]
DRAWING_S = 10.0
#: silence after which the reader is told that nothing comes [s]
SILENT_S = 3.0

STYLE = """
:root { --ink: #1c1f23; --paper: #ffffff; --faint: #5b6370; --line: #d5d8de; --card: #f6f7f9; --bad: #b3261e; }
body.body--dark { --ink: #e4e6ea; --paper: #15171a; --faint: #a3aab6; --line: #363b43; --card: #1e2126; }
body { color: var(--ink); background: var(--paper); font: 16px/1.45 system-ui, "Segoe UI", Roboto, Arial, sans-serif; }
.nicegui-content { padding: 0; gap: 0; align-items: stretch; }
.bar { position: sticky; top: 0; z-index: 10; display: flex; flex-wrap: wrap; gap: 0.3rem 1.2rem; align-items: center;
  padding: 0.6rem clamp(0.7rem, 2vw, 1.6rem); background: var(--card); border-bottom: 1px solid var(--line); }
.bar .state { flex: 1 1 16rem; min-width: 0; }
.bar h1 { font-size: 1.05rem; line-height: 1.3; font-weight: 600; margin: 0; }
.left { font-variant-numeric: tabular-nums; color: var(--faint); }
.q-btn { text-transform: none; }
.abort { background: var(--bad) !important; color: #fff !important; font-size: 1.05rem; font-weight: 700;
  min-height: 3rem; padding: 0 1.4rem; border-radius: 6px; }
.plain { color: var(--ink) !important; border: 1px solid var(--line); }
:focus-visible { outline: 3px solid #3b82c4 !important; outline-offset: 2px; }
.page { display: grid; gap: 0.6rem 1.4rem; padding: 0.8rem clamp(0.7rem, 2vw, 1.6rem) 2rem;
  grid-template-columns: minmax(0, 1fr); }
.page > *, .page section { min-width: 0; }
.page h2 { font-size: 1rem; line-height: 1.3; font-weight: 600; margin: 0.4rem 0 0.2rem; }
.warn { border-left: 6px solid #d98200; padding: 0.4rem 0.8rem; background: var(--card); white-space: pre-line; }
.head { display: flex; flex-wrap: wrap; gap: 0 1rem; align-items: center; justify-content: space-between; }
.note { color: var(--faint); font-size: 0.9rem; }
.strip { height: min(58vh, 560px); min-height: 380px; } .bode { height: 400px; } .plane, .steps { height: 330px; }
.outcome { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 0.7rem 1rem 1rem; }
.gains { display: grid; grid-template-columns: auto repeat(2, minmax(0, auto)); justify-content: start;
  gap: 0.2rem 1.6rem; font-variant-numeric: tabular-nums; margin: 0.5rem 0; }
.gains .here { font-weight: 700; }
.choice { display: flex; flex-wrap: wrap; gap: 0.5rem 1rem; align-items: center; margin-top: 0.5rem; }
.asked .outcome { order: -1; }
@media (min-width: 1000px) {
  .page { grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); grid-template-rows: auto auto 1fr; }
  .warnings { grid-row: 1; grid-column: 1 / -1; } .frequency { grid-row: 2 / span 2; grid-column: 2; }
  .time, .asked .outcome { grid-row: 2; grid-column: 1; } .outcome, .asked .time { grid-row: 3; grid-column: 1; } }
@media (max-width: 520px) { body { font-size: 15px; } .abort { width: 100%; } }
"""

#: the browser says when its colours have changed, so that the charts' text follows
WATCH_COLOURS = """<script>
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => emitEvent("colours"));
</script>"""


class Screen:
    """One browser page.

    Parameters
    ----------
    story : Story
        What is shown; somebody else polls it.
    pictures : Pictures
        Its charts.
    controls : Controls
        Which page may act, and what its actions do.
    client : Client
        The page.

    Attributes
    ----------
    tab : str or None
        The browser tab it is in; kept through a reload, None before it has connected.
    """

    def __init__(self, story: Story, pictures: Pictures, controls: Controls, client: Client) -> None:
        self._story, self._pictures, self._controls, self._client = story, pictures, controls, client
        self.tab: str | None = None
        self._span_s = 60.0 if story.ended is None else math.inf
        self._shown: tuple[Any, ...] = ()
        self._gains_news = -1
        self._drawn_s = -math.inf
        self._drawing = False
        self._seen_rows, self._seen_s = -1, time.monotonic()
        ui.add_css(STYLE)
        ui.add_head_html(WATCH_COLOURS)
        ui.colors(primary="#1f6fb2")
        self._dark = ui.dark_mode(None)
        ui.on("colours", self._redraw)
        ui.keyboard(self._on_key, repeating=False, ignore=[])
        self._bar()
        with ui.element("main").classes("page") as self._main:
            self._warnings = ui.label().classes("warn warnings").props("role=alert")
            self._time_section()
            self._outcome_section()
            self._frequency_section()
        self._show_words()  # so that a browser shows nothing for a moment that is not so

    def _bar(self) -> None:
        with ui.element("header").classes("bar"):
            self._abort = ui.button("Abort (Esc)", on_click=self._on_abort, color=None).classes("abort")
            self._abort.props('aria-label="Abort: safe output now. Key: Escape"')
            with ui.element("div").classes("state"):
                self._title = Heading()
                self._state = ui.label().props("role=status")
                self._left = ui.label().classes("left")
            self._role = ui.label().classes("note")
            self._take = (
                ui.button("Take the controls", on_click=self._on_take, color=None).classes("plain").props("flat")
            )
            ui.button("Light / dark", on_click=self._on_dark, color=None).classes("plain").props("flat")

    def _time_section(self) -> None:
        with ui.element("section").classes("time"):
            with ui.element("div").classes("head"):
                ui.html("Measurement and command", tag="h2")
                toggle = ui.toggle(SPANS, value=self._span_s, on_change=lambda change: self._on_span(change.value))
                toggle.props('dense no-caps unelevated aria-label="Time shown"')
            self._strip = ui.echart({}).classes("strip full-width")
            self._strip.on("chart:finished", self._on_drawn, args=[])
            self._relay = ui.label()
            self._limits = ui.label().classes("note")

    def _frequency_section(self) -> None:
        with ui.element("section").classes("frequency"):
            ui.html("Bode diagram of the plant", tag="h2")
            self._bode = ui.echart({}).classes("bode full-width")
            ui.html("Points in the complex plane", tag="h2")
            self._plane = ui.echart({}).classes("plane full-width")
            self._plane_note = ui.label().classes("note")

    def _outcome_section(self) -> None:
        with ui.element("section").classes("outcome") as self._outcome:
            ui.html("Outcome", tag="h2")
            self._verdict = ui.label()
            self._gains = ui.element("div").classes("gains").props('role=table aria-label="Old and new gains"')
            self._steps = ui.echart({}).classes("steps full-width")
            self._steps_note = ui.label(
                "Set-point step, then load step: measured, and predicted with the band that holds 95 % of readings."
            ).classes("note")
            with ui.element("div").classes("choice") as self._choice:
                ui.button("Keep new gains", on_click=lambda: self._on_choice("keep"), color=None).classes(
                    "plain"
                ).props("flat")
                ui.button("Restore old gains", on_click=lambda: self._on_choice("restore"), color=None).classes(
                    "plain"
                ).props("flat")

    @property
    def is_connected(self) -> bool:
        """Whether the browser is there now."""
        return bool(self._client.has_socket_connection)

    @property
    def _holds_controls(self) -> bool:
        return self.tab is not None and self._controls.holder == self.tab

    @property
    def _may_abort(self) -> bool:
        """Whether there is something to stop: not before the decision, when the rig is at rest."""
        story = self._story
        return self._holds_controls and self._controls.act is not None and story.ended is None and not story.waiting_s

    def update(self) -> None:
        """Show what is new; a browser that has not drawn the last picture yet is left in peace."""
        if not self.is_connected:
            return
        self._show_words()
        now_s = time.monotonic()
        if now_s - self._drawn_s < (DRAWING_S if self._drawing else PICTURE_S):
            return
        story = self._story
        rows, facts = (len(story.rows.t), self._span_s), (story.news, self._dark.value)
        if (rows, facts) == self._shown:
            return
        if self._shown[1:] != (facts,):
            bode, plane, times, steps = self._pictures.facts()
            self._show(self._bode, bode)
            self._show(self._plane, plane)
            size = f"drawn {times:g} times as large" if times > 1.0 else "in their true size"
            self._plane_note.text = f"At the angular frequencies beside them [rad/s]; 95 % regions {size}."
            self._show(self._steps, steps)
        self._shown = (rows, facts)
        self._drawing, self._drawn_s = True, now_s
        self._show(self._strip, self._pictures.strip(self._span_s))

    @staticmethod
    def _show(chart: ui.echart, options: dict[str, Any]) -> None:
        chart.options.clear()
        chart.options.update(options)

    def _show_words(self) -> None:
        story, controls = self._story, self._controls
        self._title.text = story.config.name if story.config is not None else "waiting for a run"
        self._state.text, self._left.text = self._state_text(), self._remaining_text()
        self._relay.text, self._limits.text = story.relay_text(), story.limits_text()
        warnings = [*story.warnings(), *self._silence()]
        self._warnings.text = "\n".join(warnings)
        self._warnings.set_visibility(bool(warnings))
        acts, over = controls.act is not None, story.ended is not None
        self._abort.set_visibility(self._may_abort)
        self._take.set_visibility(acts and not over and controls.holder is None)
        self._role.text = self._role_text(acts, over)
        self._main.classes(**{"add" if story.waiting_s else "remove": "asked"})
        self._outcome.set_visibility(bool(story.verdict or story.gains))
        if story.verdict or story.gains:
            self._show_outcome()

    def _state_text(self) -> str:
        story = self._story
        if story.ended is not None:
            return f"Ended: {story.ended}; {sentence(story.output)}."
        if self._controls.run_is_gone:
            return "The run is gone without a word: it was killed. The device's own dead-man timer has to act."
        if story.waiting_s:
            return "The rig holds the new gains. Keep them, or restore the old ones?"
        return f"{story.state.capitalize()}: {story.message}"

    def _remaining_text(self) -> str:
        story = self._story
        if story.ended is not None:
            return f"{story.now_s:.0f} s on the rig"
        if story.waiting_s:
            return f"{story.decision_s:.0f} s left to decide; without an answer the new gains stay"
        left = (
            f"{story.remaining_s:.0f} s left in this state"
            if math.isfinite(story.remaining_s)
            else "time left: not known yet"
        )
        return f"{story.now_s:.1f} s on the rig, {left}"

    def _role_text(self, acts: bool, over: bool) -> str:
        refused = self._controls.refused
        said = f"; {refused} request{'s' * (refused > 1)} of others refused" if refused else ""
        return f"{self._role_words(acts, over)}{said}"

    def _role_words(self, acts: bool, over: bool) -> str:
        if over or not acts:
            return "Replay" if over else "This page looks on"
        if self._controls.aborted:
            return "Abort was pressed"
        if self._holds_controls:
            return "This page holds the controls"
        return "Nobody holds the controls" if self._controls.holder is None else "Another page holds the controls"

    def _silence(self) -> list[str]:
        rows, now_s = len(self._story.rows.t), time.monotonic()
        if rows != self._seen_rows:
            self._seen_rows, self._seen_s = rows, now_s
        quiet_s = now_s - self._seen_s
        if self._story.ended is None and not self._story.waiting_s and quiet_s > SILENT_S:
            return [f"No new sample for {quiet_s:.0f} s: the run computes, hangs or was killed."]
        return []

    def _show_outcome(self) -> None:
        story = self._story
        self._verdict.text = story.outcome_text()
        self._steps.set_visibility(bool(story.steps))
        self._steps_note.set_visibility(bool(story.steps))
        self._choice.set_visibility(story.waiting_s > 0.0 and self._controls.act is not None)
        for button in self._choice:
            if isinstance(button, ui.button):
                button.set_enabled(self._holds_controls)
        if self._gains_news == story.news:
            return
        self._gains_news = story.news
        self._gains.clear()
        with self._gains:
            for cells in _gain_rows(story):
                for i, cell in enumerate(cells):
                    here = story.gains is not None and i == (2 if story.gains.deployed else 1)
                    ui.label(cell).classes("here" if here else "")

    def _redraw(self) -> None:
        self._shown = ()

    def _on_drawn(self) -> None:
        self._drawing = False

    def _on_span(self, span_s: float) -> None:
        self._span_s = span_s

    def _on_dark(self) -> None:
        async def toggle() -> None:
            dark = await ui.run_javascript("document.body.classList.contains('body--dark')")
            self._dark.value = not dark

        ui.timer(0.0, toggle, once=True)

    def _on_key(self, event: KeyEventArguments) -> None:
        if event.action.keydown and event.key.escape:
            self._on_abort()

    def _on_abort(self) -> None:
        if self._may_abort:
            self._controls.ask("abort")

    def _on_choice(self, choice: str) -> None:
        if self._holds_controls and self._story.waiting_s:
            self._controls.ask(choice)

    def _on_take(self) -> None:
        self._controls.take(self.tab)

    def arrive(self) -> None:
        """Note which browser tab this is, once it has connected."""
        self.tab = self._client.tab_id
        self._controls.arrive(self.tab)


class Heading(TextElement):
    """A heading whose text is text whatever it says: the name of a run comes from a file."""

    def __init__(self) -> None:
        super().__init__(tag="h1", text="")


def _gain_rows(story: Story) -> list[tuple[str, str, str]]:
    old = story.gains.old if story.gains is not None else None
    new = story.gains.new if story.gains is not None else story.controller
    u_unit, y_unit = story.units

    def cell(controller: PIDController | None, name: str) -> str:
        return "-" if controller is None else f"{getattr(controller, name):.4g}".replace("inf", "∞")

    rows = [("", "old gains", "new gains")]
    names = {"K": ratio_title("K", u_unit, y_unit), "Ti_s": "T_I [s]", "Td_s": "T_d [s]", "Tf_s": "T_f [s]"}
    for name, text in names.items():
        if name in ("K", "Ti_s") or any(c is not None and getattr(c, name) for c in (old, new)):
            rows.append((text, cell(old, name), cell(new, name)))
    return rows


def build(story: Story, controls: Controls, screens: set[Screen]) -> Callable[[Client], None]:
    """Return the function that builds a page for a browser that asks for one.

    Parameters
    ----------
    story : Story
        The run that the pages show.
    controls : Controls
        What their buttons do.
    screens : set of Screen
        The open pages; each adds itself, and leaves when its browser does.
    """
    pictures = Pictures(story)

    def page(client: Client) -> None:
        screen = Screen(story, pictures, controls, client)
        screens.add(screen)
        client.on_connect(screen.arrive)
        client.on_delete(lambda: screens.discard(screen))

    return page
