"""Tasks on Dask: workers that are killed, drives that fail for a moment, schedulers that are elsewhere."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from distributed import Client, LocalCluster
from distributed.comm import connect
from distributed.security import Security

from autotune.batch import engine
from autotune.batch.engine import cluster, run_all
from autotune.errors import InputError


def test_a_killed_worker_costs_only_its_task(two_workers, tmp_path):
    tasks = {f"task {i}": tmp_path / str(i) for i in range(20)}
    gate = tmp_path / "gate"
    os.mkfifo(gate)

    def answer(path: Path) -> str:
        with path.open("a") as attempts:
            attempts.write(f"{os.getpid()}\n")
        if path.name == "7" and len(path.read_text().splitlines()) == 1:
            gate.read_bytes()  # blocks: nobody ever writes there
        return path.name

    running = run_all(two_workers, answer, tasks)
    answers = dict(next(running) for _ in range(19))
    os.kill(int((tmp_path / "7").read_text()), signal.SIGKILL)
    answers |= dict(running)
    attempts = {name: len(path.read_text().splitlines()) for name, path in tasks.items()}
    assert answers == {name: path.name for name, path in tasks.items()}
    assert attempts == dict.fromkeys(tasks, 1) | {"task 7": 2}


def test_a_task_that_kills_every_worker_ends_as_its_own_failure(two_workers, monkeypatch):
    monkeypatch.setattr(two_workers.cluster.scheduler, "allowed_failures", 0)

    def dies(_: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    ((name, error),) = run_all(two_workers, dies, {"a": 0})
    assert (name, "every worker that took it was killed" in str(error)) == ("a", True)
    assert dict(run_all(two_workers, abs, {"b": -1, "c": 2})) == {"b": 1, "c": 2}


def test_a_drive_that_fails_for_a_moment_is_asked_again(two_workers, tmp_path):
    def answer(path: Path) -> str:
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            return "read"
        raise OSError("network drive away")

    assert dict(run_all(two_workers, answer, {"a": tmp_path / "seen"})) == {"a": "read"}


def test_a_task_that_keeps_failing_ends_with_its_error(two_workers):
    def answer(_: int) -> None:
        raise OSError("network drive away")

    ((_, error),) = run_all(two_workers, answer, {"a": 0})
    assert isinstance(error, OSError)


def test_kernels_come_compiled_from_the_disk_to_every_worker(two_workers):
    def compiled_here() -> int:
        from autotune.identification.frequency import reference_model as module

        model = module.ReferenceModel(K=1.0, p=0.1, tau=0.1, L=0.1)
        module.simulate_reference(np.arange(9.0), np.ones(9), model)
        return sum(module._simulate.stats.cache_misses.values())

    compiled_here()  # once on this machine, by whoever comes first
    two_workers.wait_for_workers(2)
    assert list(two_workers.run(compiled_here).values()) == [0, 0]


def test_the_embedded_cluster_is_out_of_reach_of_other_machines(two_workers):
    found = two_workers.scheduler_info(n_workers=-1)
    addresses = [found["address"], *found["workers"], *(worker["nanny"] for worker in found["workers"].values())]
    assert {urlsplit(address).hostname for address in addresses} == {"127.0.0.1"}
    pids = {os.getpid(), *two_workers.run(os.getpid).values()}
    listening = {
        c.laddr.ip
        for pid in pids
        for c in psutil.Process(pid).net_connections("inet")
        if c.status == psutil.CONN_LISTEN
    }
    assert listening == {"127.0.0.1"}


def test_a_scheduler_that_asks_for_certificates_is_refused_in_one_line(two_workers):
    address = two_workers.scheduler.address
    with pytest.raises(InputError, match="no certificate is configured"), cluster(scheduler=address):
        pass


def test_an_existing_scheduler_and_its_two_workers(scheduler):
    with cluster(scheduler=scheduler) as client:
        client.wait_for_workers(2, timeout=30)
        answers = dict(run_all(client, lambda number: (number**2, os.getpid()), {str(i): i for i in range(8)}))
        assert {name: square for name, (square, _) in answers.items()} == {str(i): i**2 for i in range(8)}
        assert os.getpid() not in {pid for _, pid in answers.values()}
    with cluster(scheduler=scheduler) as again:  # closing the first connection left the scheduler alone
        assert len(again.scheduler_info(n_workers=-1)["workers"]) == 2


def clients() -> int:
    """Count the clients in memory: one whose making failed closes itself when it is collected, in any thread."""
    return sum(type(each) is Client for each in gc.get_objects())


def test_nobody_at_the_address_is_said_at_once(monkeypatch):
    monkeypatch.setattr(engine, "_PATIENCE_S", 0.2)
    before = clients()
    with (
        pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9.*dask scheduler"),
        cluster(scheduler="tcp://127.0.0.1:9"),
    ):
        pass
    assert clients() <= before  # one of an earlier test may be collected meanwhile


def test_a_scheduler_without_workers_is_said(monkeypatch):
    monkeypatch.setattr(engine, "_PATIENCE_S", 0.5)
    with (
        LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0") as empty,
        pytest.raises(InputError, match="no worker is connected"),
        cluster(scheduler=empty.scheduler_address),
    ):
        pass


@pytest.mark.parametrize("protocol", ["tls", "tcp"])
def test_another_user_of_the_machine_cannot_have_the_scheduler_run_code(two_workers, tmp_path, protocol):
    address = urlsplit(two_workers.scheduler.address)
    assert (address.scheme, address.hostname) == ("tls", "127.0.0.1")
    stranger = Security.temporary() if protocol == "tls" else Security()  # a certificate of his own
    arguments = stranger.get_connection_args("client")
    with pytest.raises(OSError, match=r"Timed out|does not match|handshake|refused|closed"):
        asyncio.run(connect(f"{protocol}://{address.netloc}", timeout=2.0, **arguments))


def test_a_cluster_of_threads_listens_nowhere():
    with cluster(workers=1, processes=False) as client:
        assert client.scheduler.address.startswith("inproc://")


INTERRUPTED = """
import os, signal, sys, threading, time
from autotune.batch.engine import cluster
try:
    threading.Timer(float(sys.argv[1]), os.killpg, (os.getpid(), signal.SIGINT)).start()
    with cluster(workers=2) as client:
        client.submit(time.sleep, 600).result()
except KeyboardInterrupt:
    print("stopped", file=sys.stderr)
"""


@pytest.mark.parametrize("after_s", [0.0, 0.2, 1.0, 4.0])
def test_ctrl_c_while_workers_start_is_one_line(tmp_path, after_s):
    path = tmp_path / "interrupted.py"
    path.write_text(f"if __name__ == '__main__':\n{textwrap.indent(INTERRUPTED, '    ')}")
    command = [sys.executable, str(path), str(after_s)]
    done = subprocess.run(command, capture_output=True, text=True, start_new_session=True, check=False)
    assert done.stderr == "stopped\n"
