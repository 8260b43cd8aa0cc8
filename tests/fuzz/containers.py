"""Families of damaged containers: workbooks, Parquet files, FMUs, and the journals that a run is gone on with."""

from __future__ import annotations

import io
import json
import random
import re
import zipfile
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import fmpy

from tests.autotune.equations.fmu_build import description, description_3
from tests.fuzz.damage import CELLS, damaged_bytes, damaged_json
from tests.fuzz.sound import CONFIG, DESIGN, MODEL, POINTS, PROGRESS, RECORDING, Call, put

#: What a number, a reference or a kind of cell may have become in a workbook's or a model description's XML.
_VALUES = (*CELLS, "9" * 400, "1e999", "true", "&lt;", "&#0;", "\u202e", "<v/>")
_REFERENCES = ("A99999999999999999999", "XFD1048576", "A0", "", "a1", "A1:B2", "ZZZZZ1", "1A", "A-1")


def _zipped(members: dict[str, bytes], how: int = zipfile.ZIP_DEFLATED) -> bytes:
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", how) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return held.getvalue()


def _unzipped(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@cache
def _workbook() -> bytes:
    from openpyxl import Workbook

    book = Workbook()
    for row in RECORDING.splitlines()[:80]:
        book.active.append([float(cell) if cell[-1].isdigit() else cell for cell in row.split(",")])
    held = io.BytesIO()
    book.save(held)
    return held.getvalue()


def _changed(rng: random.Random, data: bytes, pattern: bytes, values: tuple[str, ...]) -> bytes:
    """Replace what the first group of a pattern finds, in one to thirty places."""
    found = list(re.finditer(pattern, data))
    for match in sorted(rng.sample(found, min(len(found), rng.choice((1, 1, 3, 30)))), key=lambda m: -m.start(1)):
        data = data[: match.start(1)] + rng.choice(values).encode() + data[match.end(1) :]
    return data


def workbooks(rng: random.Random, folder: Path) -> Call:
    """Workbooks whose cells, references, members or bytes are damaged."""
    way, data = rng.random(), _workbook()
    if way < 0.25:
        data = damaged_bytes(rng, data)
    else:
        members = _unzipped(data)
        sheet = next(name for name in members if name.endswith("sheet1.xml"))
        if way < 0.5:
            members[sheet] = _changed(rng, members[sheet], rb"<v>([^<]*)</v>", _VALUES)
        elif way < 0.7:
            members[sheet] = _changed(rng, members[sheet], rb' r="([A-Z]*\d+)"', _REFERENCES)
        elif way < 0.8:
            members[sheet] = _changed(rng, members[sheet], rb' t="([a-z]+)"', ("s", "n", "b", "e", "d", "str", "x"))
        elif way < 0.9:
            name = rng.choice(sorted(members))
            members[name] = damaged_bytes(rng, members[name])
        else:
            del members[rng.choice(sorted(members))]
        data = _zipped(members)
    return _read(rng, folder, put(folder, rng.choice(("r.xlsx", "r.xlsx", "r.xlsm", "r.ods", "r.xls")), data))


def _column(rng: random.Random, values: list[float]) -> Any:
    """Return a column of another type than of numbers, or of other numbers."""
    import pyarrow as pa

    n, begin = len(values), datetime(2026, 3, 29, tzinfo=UTC)
    ways = (
        lambda: pa.array(values),
        lambda: pa.array([rng.choice((v, None, float("nan"), 1e300, -1e300)) for v in values]),
        lambda: pa.array([[v] for v in values]),
        lambda: pa.array([{"a": v} for v in values]),
        lambda: pa.array([rng.choice(CELLS) for _ in values]),
        lambda: pa.array([f"{v}" for v in values]),
        lambda: pa.array([b"\xff\xfe"] * n),
        lambda: pa.array([v > 0.0 for v in values]),
        lambda: pa.nulls(n),
        lambda: pa.array([begin + timedelta(seconds=rng.choice((0.1, 1.0, -1.0, 1e6)) * i) for i in range(n)]),
        lambda: pa.array([int(v * 10) for v in values]).cast(pa.int8(), safe=False),
        lambda: pa.array(values).cast(pa.float16()),
        lambda: pa.array([str(round(v)) for v in values]).dictionary_encode(),
        lambda: pa.array([timedelta(seconds=v) for v in values]),
    )
    return rng.choice(ways)()


def parquet(rng: random.Random, folder: Path) -> Call:
    """Parquet files whose columns are of other types, named otherwise, few, or whose bytes are damaged."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [[float(cell) for cell in row.split(",")] for row in RECORDING.splitlines()[1:]]
    columns = dict(zip(("t", "u", "y"), ([row[i] for row in rows] for i in range(3)), strict=True))
    damaged = {name: _column(rng, v) if rng.random() < 0.45 else pa.array(v) for name, v in columns.items()}
    if rng.random() < 0.2:
        damaged[rng.choice(("", "t ", "T", "x" * 300, "\x1b[2J", "quality"))] = damaged.pop(rng.choice(sorted(damaged)))
    table, held = pa.table(damaged), io.BytesIO()
    pq.write_table(table.slice(0, rng.choice((0, 1, 2, 60, 240, 240, 240))), held)
    data = held.getvalue() if rng.random() < 0.75 else damaged_bytes(rng, held.getvalue())
    return _read(rng, folder, put(folder, rng.choice(("r.parquet", "r.pq")), data))


def _read(rng: random.Random, folder: Path, given: str) -> Call:
    import tomli_w

    way = rng.random()
    if way < 0.4:
        return ["import", given, "--out", str(folder / "imported.csv")]
    if way < 0.6:
        return ["identify", "frequency", given, "--out", str(folder / "out.json")]
    model = put(folder, "sound_model.toml", tomli_w.dumps(MODEL))
    return ["simulate", "--model", model, given, "--out", str(folder / "out.csv")]


def fmus(rng: random.Random, folder: Path) -> Call:
    """FMUs whose description, members or bytes are damaged; their native code is empty, as it may do anything."""
    kinds = rng.choice((("CoSimulation",), ("ModelExchange",), ("CoSimulation", "ModelExchange")))
    text = rng.choice((description, description_3))(kinds).encode()
    if rng.random() < 0.7:
        odd = ("", "nan", "inf", "-1", "1e999", "x", "0", "9" * 400, "99999999999", "\u202e", "&lt;", "true")
        text = _changed(rng, text, rb'\w+="([^"]*)"', odd)
    else:
        text = damaged_bytes(rng, text)
    library = f"rig{fmpy.sharedLibraryExtension}"
    code = {f"binaries/{name}/{library}": b"" for name in (fmpy.platform, fmpy.platform_tuple)}
    data = _zipped({"modelDescription.xml": text, **code} if rng.random() < 0.95 else {})
    fmu = put(folder, "rig.fmu", data if rng.random() < 0.9 else damaged_bytes(rng, data))
    if rng.random() < 0.6:
        return ["model", "from-fmu", fmu, "--out", str(folder / "m.toml")]
    model = put(folder, "m.toml", 'name = "rig"\nfmu = "rig.fmu"\n[[input]]\ncolumn = "u"\n[output]\nvalue = "phi"\n')
    return ["model", "check", model] if rng.random() < 0.7 else ["simulate", "--model", model,
            put(folder, "r.csv", RECORDING), "--out", str(folder / "out.csv")]  # fmt: skip


#: A hand-over and the audit of it, as they are written.
GAINS = {"K": -0.01, "Ti_s": 6.0, "Td_s": 0.0, "Tf_s": 0.0, "setpoint_weight": 1.0}
JOURNAL = [
    {"gains": step, "at": "2026-03-01T12:00:00.000+00:00", **GAINS}
    for step in ("read", "writing", "written and read back, on trial", "restoring")
]
AUDIT = {"at": "2026-03-01T12:00:00.000+00:00", "who": "a", "host": "h", "rig": "ball", "verdict": "kept", "old": GAINS}


def _lines(rng: random.Random, sound: list[dict[str, Any]]) -> bytes:
    lines = [json.dumps(line).encode() for line in sound[: rng.randrange(1, len(sound) + 1)]]
    i = rng.randrange(len(lines))
    lines[i] = damaged_json(rng, sound[i]) if rng.random() < 0.7 else damaged_bytes(rng, lines[i])
    return b"\n".join(lines) + rng.choice((b"\n", b"\n", b""))


def journals(rng: random.Random, folder: Path) -> Call:
    """Journals of gains, audit logs and run folders that are damaged: the next hand-over, or the run gone on with."""
    import tomli_w

    config = put(folder, "config.toml", tomli_w.dumps(CONFIG))
    if rng.random() < 0.7:
        out = folder / "gains"
        out.mkdir()
        put(out, "journal.jsonl", _lines(rng, JOURNAL) if rng.random() < 0.7 else json.dumps(JOURNAL[0]) + "\n")
        if rng.random() < 0.4:
            put(out, "audit.jsonl", _lines(rng, [AUDIT]))
        design = put(folder, "design.json", json.dumps(DESIGN))
        return ["deploy", config, "--design", design, "--no-verify", "--yes", "--out", str(out)]
    put(folder, "progress.jsonl", _lines(rng, list(PROGRESS)))
    put(folder, "points.json", json.dumps(POINTS) if rng.random() < 0.5 else damaged_json(rng, POINTS))
    put(folder, "recording.csv", RECORDING)
    return ["run", "--resume", str(folder), "--no-verify"]
