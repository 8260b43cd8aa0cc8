"""Many loops at once: one worker against two on recordings of 6,000 rows, design included, and the memory they take.

``AUTOTUNE_BATCH_LOOPS=1000 python -m tests.benchmarks batch`` runs the full count; 100 loops by default. Efficiency is
the time of one worker over twice that of two; on a machine that does other things as well, the processor time that the
workers used tells more: it leaves out what the others took, and counts what the engine and a second worker cost.
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
from distributed import Client
from scipy.signal import cont2discrete, lfilter

from autotune.batch.campaign import Campaign, write_results
from autotune.batch.engine import cluster, run_all
from autotune.batch.loop import Finding, analyse_loop
from autotune.batch.row import Row
from autotune.batch.settings import read_campaign

ROWS, SAMPLE_S = 6000, 0.1
MEGABYTE = 2.0**20


def make_recording(path: Path, seed: int) -> None:
    """Write the recording of a random plant: two lags, dead time, random binary steps about a working point, noise."""
    rng = np.random.default_rng(seed)
    tau = rng.uniform(1.0, 6.0) * np.array([1.0, rng.uniform(0.05, 0.5)])
    gain, late = rng.uniform(0.5, 3.0), rng.integers(1, 9)
    num, den, _ = cont2discrete(([gain], np.polymul([tau[0], 1.0], [tau[1], 1.0])), SAMPLE_S)
    steps = np.repeat(rng.choice([-0.5, 0.5], ROWS), rng.integers(3, 40, ROWS))[:ROWS]
    y = lfilter(num.ravel(), den, np.concatenate([np.zeros(late), steps])[:ROWS]) + rng.normal(0.0, 0.01, ROWS)
    columns = np.column_stack([SAMPLE_S * np.arange(ROWS), 50.0 + steps, 20.0 + y])
    np.savetxt(path, columns, fmt="%.6g", delimiter=",", header="t,u,y", comments="")


@dataclass(frozen=True, kw_only=True)
class Run:
    """One campaign: seconds on the clock, processor time of workers and engine, memory after each tenth [MB]."""

    wall_s: float
    workers_s: float
    engine_s: float
    workers_mb: list[float]
    engine_mb: list[float]
    rows: tuple[Row, ...]


def used(client: Client) -> tuple[float, float]:
    """Return the processor time [s] and the memory [MB] of all workers together."""

    def of_this_process() -> tuple[float, float]:
        process = psutil.Process()
        times = process.cpu_times()
        return times.user + times.system, process.memory_info().rss / MEGABYTE

    found = list(client.run(of_this_process).values())
    return sum(cpu for cpu, _ in found), sum(memory for _, memory in found)


def run(folder: Path, out: Path, workers: int) -> Run:
    """Run the campaign of a folder from its beginning; the cluster is up and its imports are done before it counts."""
    settings, loops = read_campaign(folder / "campaign.toml")
    campaign = Campaign(settings=settings, loops=loops, out=out)
    with cluster(workers) as client:
        works = campaign.works((), lambda name, share: None)
        client.run(analyse_loop, next(iter(works.values())))
        rows: list[Row] = []
        engine_mb, workers_mb = [], []
        cpu_0, _ = used(client)
        wall_0, engine_0 = time.perf_counter(), time.process_time()
        for name, finding in run_all(client, analyse_loop, works):
            assert isinstance(finding, Finding), finding
            rows.append(campaign.keep(works[name].loop, finding))
            if len(rows) % max(len(works) // 10, 1) == 0:
                engine_mb.append(psutil.Process().memory_info().rss / MEGABYTE)
                workers_mb.append(used(client)[1])
        wall, engine = time.perf_counter() - wall_0, time.process_time() - engine_0
        cpu = used(client)[0] - cpu_0
    ordered = write_results(rows, out / "results.parquet")
    return Run(wall_s=wall, workers_s=cpu, engine_s=engine, workers_mb=workers_mb, engine_mb=engine_mb, rows=ordered)


def main() -> None:
    """Print the table."""
    loops = int(os.environ.get("AUTOTUNE_BATCH_LOOPS", "100"))
    with tempfile.TemporaryDirectory(prefix="autotune-batch-") as name:
        folder = Path(name)
        (folder / "rec").mkdir()
        for seed in range(loops):
            make_recording(folder / "rec" / f"loop_{seed:04d}.csv", seed)
        (folder / "campaign.toml").write_text('name = "b"\nfolder = "rec/*.csv"\n[design]\nnoise_gain = 5.0\n')
        print(
            f"{loops} recordings of {ROWS} rows, identify and design; load {os.getloadavg()[0]:.1f} on {os.cpu_count()}"
        )
        runs = {workers: run(folder, folder / f"out{workers}", workers) for workers in (1, 2)}
        same = (folder / "out1" / "results.parquet").read_bytes() == (folder / "out2" / "results.parquet").read_bytes()
    for workers, one in runs.items():
        print(
            f"  {workers} worker(s): {one.wall_s:7.1f} s on the clock, {one.workers_s:7.1f} s of processor in workers, "
            f"{one.engine_s:5.1f} s in engine and client"
        )
        print(f"    memory of the workers [MB]: {' '.join(f'{m:.0f}' for m in one.workers_mb)}")
        print(f"    memory of the client [MB]:  {' '.join(f'{m:.0f}' for m in one.engine_mb)}")
    one, two = runs[1], runs[2]
    print(f"  efficiency of 2 workers against 1, clock:          {one.wall_s / (2.0 * two.wall_s):.3f} (asked 0.85)")
    share = one.workers_s / (two.workers_s + two.engine_s)
    print(f"  efficiency, processor time of all against 1 worker: {share:.3f}")
    print(f"  tables byte for byte the same: {'yes' if same else 'NO'}")
    print(f"  failed loops: {sum(row.attention == 'failed' for row in two.rows)}")
