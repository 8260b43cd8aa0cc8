"""What every page has around its sections: the document, its styles, and the scripts for tables and charts."""

from __future__ import annotations

SHELL = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>@TITLE@</title>
<style>
:root { color-scheme: light dark; --ink: #1c1f23; --paper: #fff; --faint: #667; --line: #d5d8de; --card: #f6f7f9; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e6ea; --paper: #15171a; --faint: #9aa1ad; --line: #363b43; --card: #1e2126; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 1.2rem clamp(0.7rem, 3vw, 2.2rem) 4rem; color: var(--ink);
  background: var(--paper); font: 16px/1.55 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.65rem; line-height: 1.25; margin: 0.6rem 0 0.8rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 0.5rem; padding-top: 0.5rem; border-top: 1px solid var(--line); }
p { max-width: 78ch; margin: 0.5rem 0; }
.verdict { font-size: 1.1rem; font-weight: 600; padding: 0.7rem 1rem; border-left: 6px solid; background: var(--card); }
.good { border-color: #0d9a72; } .warn { border-color: #d98200; } .bad { border-color: #d1495b; }
nav { display: flex; flex-wrap: wrap; gap: 0.3rem 1rem; margin: 1rem 0; font-size: 0.93rem; }
a { color: inherit; }
.wide { overflow-x: auto; margin: 0.8rem 0; } math { width: max-content; margin: 0; padding: 0.2em 0; }
.wide { background: linear-gradient(to left, var(--paper) 40%, transparent) right / 2rem 100% no-repeat local,
  linear-gradient(to left, #8889, transparent) right / 0.8rem 100% no-repeat scroll; }  /* a shadow where it goes on */
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.93rem; }
.caption { color: var(--faint); font-size: 0.93rem; margin-top: 1.2rem; }
th, td { text-align: left; padding: 0.3rem 0.9rem 0.3rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; } th button { all: unset; cursor: pointer; }
th button:focus-visible { outline: 2px solid var(--faint); }
th[aria-sort="ascending"] button::after { content: " \\2191"; }
th[aria-sort="descending"] button::after { content: " \\2193"; }
.sought { font: inherit; padding: 0.25rem 0.6rem; margin-top: 0.6rem; width: min(100%, 22rem); }
@media print { .sought { display: none; } }
.answers { display: grid; gap: 0.8rem; margin: 1rem 0; }
.answers { grid-template-columns: repeat(auto-fit, minmax(min(17rem, 100%), 1fr)); }
.answers div { background: var(--card); padding: 0.6rem 0.9rem; border-radius: 6px; }
.answers dt { color: var(--faint); font-size: 0.86rem; } .answers dd { margin: 0.15rem 0 0; overflow-wrap: anywhere; }
.glance { --side: 14px; margin: 1rem 0; } .glance h3 { font-size: 0.86rem; margin: 0 0 0.2rem; font-weight: 600; }
.glance > div { display: flex; flex-wrap: wrap; gap: 0.7rem 1.4rem; } .glance section > div { line-height: 0; }
.glance a, .glance i { display: inline-block; width: var(--side); height: var(--side); margin: 0 1px 1px 0; }
.glance a:hover, .glance a:focus { outline: 2px solid var(--ink); } .glance .key { margin-bottom: 0.8rem; }
.glance .key { font-size: 0.86rem; } .glance i { width: 0.8em; height: 0.8em; margin-right: 0.35em; }
tr:has(:target) { background: #d9820033; }
.square { width: min(100%, 560px); aspect-ratio: 1; } .small { width: 100px; height: 28px; }
.chain { margin: 1.1rem 0; } .chain svg { width: 100%; height: auto; display: block; } .upright { display: none; }
.chain rect { fill: var(--card); stroke: var(--line); stroke-width: 1.5; } .chain text { fill: var(--ink); }
.chain rect.lit { fill: #d9820033; stroke: #d98200; stroke-width: 3; } .chain rect.may { stroke: #d98200; }
.chain rect.added { stroke-dasharray: 6 4; } .chain .small-print { fill: var(--faint); font-size: 12px; }
.chain .note { font-weight: 600; } .wire { stroke: var(--faint); stroke-width: 1.5; } .tip { fill: var(--faint); }
details { margin: 0.8rem 0; } summary { cursor: pointer; color: var(--faint); font-size: 0.93rem; }
.legend { display: flex; flex-wrap: wrap; gap: 0.1rem 0.4rem; }
.legend button { all: unset; cursor: pointer; font-size: 0.86rem; padding: 0.1rem 0.4rem; border-radius: 4px; }
.legend button:focus-visible { outline: 2px solid var(--faint); } .legend button[aria-pressed="false"] { opacity: 0.4; }
.legend svg { width: 26px; height: 10px; margin-right: 0.4rem; fill: none; }
figure { margin: 1.1rem 0 1.6rem; } figcaption { color: var(--faint); font-size: 0.9rem; max-width: 84ch; }
@media (max-width: 760px) { .lying { display: none; } .upright { display: block; } }
@media (max-width: 520px) { body { font-size: 15px; } h1 { font-size: 1.35rem; } table { font-size: 0.85rem; }
  td, th { padding-right: 0.45rem; } }
</style>
</head>
<body><main>
@BODY@
</main>
@CHARTS@</body></html>
"""
TABLES = """<script>
const value = (row, at) => row.cells[at].textContent.trim();
for (const table of document.querySelectorAll("table.many")) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, at) => head.firstChild.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") !== "ascending";
    heads.forEach(one => one.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const rows = [...body.rows].map(row => [value(row, at), parseFloat(value(row, at)), row]);
    const order = ([a, x], [b, y]) => isNaN(x) || isNaN(y) ? isNaN(x) - isNaN(y) || a.localeCompare(b) : x - y;
    rows.sort((a, b) => up ? order(a, b) : order(b, a));
    body.append(...rows.map(([, , row]) => row));
  }));
  table.parentElement.previousElementSibling.addEventListener("input", event => {
    const words = event.target.value.toLowerCase().split(/\\s+/);
    for (const row of body.rows) row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word));
  });
}
</script>
"""
CHARTS = """<noscript><p>The charts need JavaScript, all of which is in this file; no request is sent.</p></noscript>
<script type="text/plain" id="plotly">@PLOTLY@</script>
<script>
const own = id => JSON.parse(document.querySelector(`[data-chart="${id}"]`).textContent);
const ink = () => ({"font.color": getComputedStyle(document.body).color, "font.family": "inherit"});
async function unpacked(id) {
  const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), one => one.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
}
function narrow(layout, width) {
  if (width > 520) return;
  for (const key of Object.keys(layout).filter(key => /^[xy]axis/.test(key))) {
    const axis = layout[key], part = axis.domain ? axis.domain[1] - axis.domain[0] : 1;
    if (key[0] === "x" && axis.dtick === undefined) axis.nticks = Math.max(2, Math.floor(6 * part));
    if (axis.title) axis.title.font = {size: 12};
  }
  layout.font.size = 12;
}
function draw(div) {
  const {data, layout} = own(div.id);
  layout.font = {size: 13, color: getComputedStyle(document.body).color};
  narrow(layout, div.clientWidth);
  return Plotly.newPlot(div, data, layout, {responsive: true, displaylogo: false, displayModeBar: false});
}
async function drawAll() {
  const script = document.createElement("script");
  script.textContent = await unpacked("plotly");
  document.head.append(script);
  for (const div of document.querySelectorAll(".chart")) await draw(div);
  document.body.dataset.drawn = "yes";
}
drawAll();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
  document.querySelectorAll(".chart").forEach(div => Plotly.relayout(div, ink())));
document.querySelectorAll(".legend button").forEach(button => button.addEventListener("click", () => {
  const shown = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", shown);
  Plotly.restyle(button.dataset.of, {visible: shown}, button.dataset.traces.split(",").map(Number));
}));
</script>
"""
