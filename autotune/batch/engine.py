"""Independent tasks on Dask: a cluster in this process's own children, or one that is there already."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import dask
from dask.system import CPU_COUNT
from distributed import Client, KilledWorker, LocalCluster, Worker, as_completed
from distributed.comm import connect
from distributed.security import Security

from autotune.errors import InputError
from autotune.interrupts import interrupt_held
from autotune.version import __version__

Given = TypeVar("Given")
Answer = TypeVar("Answer")

#: The profiler's samples would fill the memory. No task waits at a worker, or it would share the blame for its death.
_EMBEDDED = {"distributed.worker.profile.enabled": False, "distributed.scheduler.worker-saturation": 1.0}
#: What a task ends with may be of its surroundings (a network drive) and pass.
_RETRIES = 2
#: An existing scheduler must answer, and have a worker, within this time [s].
_PATIENCE_S = 30.0


@contextmanager
def cluster(workers: int | None = None, scheduler: str | None = None, *, processes: bool = True) -> Iterator[Client]:
    """Connect to a Dask cluster, and leave nothing of it behind.

    Parameters
    ----------
    workers : int, optional
        Tasks that the embedded cluster runs at a time; as many as the machine has processors when absent.
    scheduler : str, optional
        Address of an existing scheduler, ``tcp://host:8786``; the embedded cluster when absent.
    processes : bool
        Whether each task of the embedded cluster has a process of its own; a thread is enough for one that starts a
        program.

    Yields
    ------
    Client
        For :func:`run_all`.

    Raises
    ------
    InputError
        No scheduler at the address, none of its workers there, or workers without this version of the tool.

    Notes
    -----
    A Dask scheduler runs any code for whoever reaches it, and every user of a machine reaches its loopback. So the
    embedded cluster speaks TLS with a certificate that is made for this campaign, held in memory only, and asked of
    both sides; with threads it stays within this process and listens nowhere. It has no dashboard, and replaces a
    worker that dies. An existing scheduler is as open as whoever runs it has made it.
    """
    if scheduler is None:
        tasks = workers or CPU_COUNT
        with dask.config.set(_EMBEDDED), _start_embedded(tasks, processes) as local, Client(local) as client:
            yield client
        return
    with _connected(scheduler) as client:
        yield client


def require_scheduler(scheduler: str) -> None:
    """Refuse an existing scheduler that cannot be worked with: asked before there is anything to send to it.

    Raises
    ------
    InputError
        As :func:`cluster` does.
    """
    with _connected(scheduler):
        pass


@contextmanager
def _connected(scheduler: str) -> Iterator[Client]:
    """Connect to an existing scheduler whose workers have this version of the tool."""
    try:
        asyncio.run(_require_answer(scheduler))
        client = Client(scheduler, timeout=_PATIENCE_S)
    except (OSError, ValueError) as error:
        raise InputError(f"no scheduler answers ({error})", where=scheduler, remedy="start dask scheduler") from None
    except TypeError:  # Dask's own answer to a tls:// address without certificates
        remedy = "name the certificates in Dask's configuration (distributed.comm.tls)"
        raise InputError("it speaks TLS, and no certificate is configured", where=scheduler, remedy=remedy) from None
    with client:
        _check(client, scheduler)
        yield client


async def _require_answer(scheduler: str) -> None:
    """Ask whether a scheduler answers, before a client is made.

    A client whose making failed closes itself when it is collected; where that happens in the thread of the next one's
    event loop, it waits for itself without end.
    """
    comm = await connect(scheduler, timeout=_PATIENCE_S, **Security().get_connection_args("client"))
    await comm.close()


def _start_embedded(tasks: int, processes: bool) -> LocalCluster:
    """Start the embedded cluster; a Ctrl-C meanwhile waits until it stands, and its processes never hear one.

    A terminal sends Ctrl-C to every process of the command. A signal that is blocked where a process is started is
    blocked in the new one from its first instruction, long before :func:`dask_setup` is reached.
    """
    with interrupt_held():
        return LocalCluster(
            n_workers=tasks if processes else 1,
            threads_per_worker=1 if processes else tasks,
            processes=processes,
            **_transport(processes),
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # it serves its health there, on any free port
            silence_logs=logging.CRITICAL,
            preload=[__name__] if processes else [],
        )


def _transport(processes: bool) -> dict[str, Any]:
    """Return how the parts of the embedded cluster speak to each other: nobody else can."""
    if not processes:
        return {"protocol": "inproc://"}
    return {"host": "127.0.0.1", "protocol": "tls://", "security": Security.temporary()}


def dask_setup(_worker: Worker) -> None:
    """Leave Ctrl-C, which a terminal sends to every process of the command, to the one that closes the cluster."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _check(client: Client, scheduler: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except TimeoutError:
        raise InputError("no worker is connected", where=scheduler, remedy=f"start dask worker {scheduler}") from None
    try:
        versions = set(client.run(_version).values())
    except ImportError as error:
        raise InputError(
            f"a worker cannot import the tool ({error})",
            where=scheduler,
            remedy="install relay-autotune where they run",
        ) from None
    if versions != {_version()}:
        raise InputError(
            f"the workers have version {', '.join(sorted(versions))}, this is {_version()}",
            where=scheduler,
            remedy="install the same version where they run",
        )


def _version() -> str:
    return __version__


def run_all(
    client: Client, function: Callable[[Given], Answer], tasks: Mapping[str, Given], *, retries: int = _RETRIES
) -> Iterator[tuple[str, Answer | Exception]]:
    """Run a function on every task, as many at a time as there are workers.

    Parameters
    ----------
    client : Client
        Of :func:`cluster`.
    function : callable
        Pure, from one task to one answer; both are sent between processes.
    tasks : mapping of str to object
        By name.
    retries : int
        How often a task that ended with an exception is tried again.

    Yields
    ------
    name : str
        Of each task as it finishes.
    answer : object
        What the function returned, or the exception that the task still ended with after its retries.

    Notes
    -----
    A task whose worker was killed is given to another; one that has killed four workers is given up (Dask's
    ``distributed.scheduler.allowed-failures``). Answers are let go of as they are yielded, so memory stays flat.
    """
    futures = client.map(function, list(tasks.values()), pure=False, retries=retries)
    names = {future.key: name for future, name in zip(futures, tasks, strict=True)}
    finished = as_completed(futures)
    del futures
    for future in finished:
        error = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker):
            error = RuntimeError("every worker that took it was killed, perhaps for want of memory")
        answer = future.result() if error is None else error
        future.release()
        yield names.pop(future.key), answer
