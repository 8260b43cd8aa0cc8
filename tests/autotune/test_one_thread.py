"""From Python, too, linear algebra keeps to one thread: sums in another order end in another digit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from autotune.diagnosis.diagnose import diagnose
from autotune.identification.closed_loop.identify import identify_closed_loop
from autotune.models import Block, Model, Port, TransferFunction
from autotune.progress import Progress
from autotune.recording import Recording

LAG_S, DT_S = 2.0, 0.1


def recording() -> Recording:
    rng = np.random.default_rng(0)
    u, y, kept = np.repeat(rng.choice([-1.0, 1.0], 60), 10), [0.0], np.exp(-DT_S / LAG_S)
    for command in u[:-1]:
        y.append(kept * y[-1] + (1.0 - kept) * command)
    return Recording(t=DT_S * np.arange(u.size), u=u, y=np.array(y) + 0.02 * rng.standard_normal(u.size))


def diagnosed(progress: Progress) -> None:
    block = Block(name="lag", place="plant", dynamics=TransferFunction(num=(1.0,), den=(LAG_S, 1.0)))
    nominal = Model(name="lag", input=Port(unit="V"), output=Port(unit="V"), blocks=(block,))
    diagnose(nominal, [recording()], progress=progress)


def identified(progress: Progress) -> None:
    identify_closed_loop(recording(), order=1, progress=progress)


@pytest.mark.parametrize("work", [diagnosed, identified])
def test_linear_algebra_keeps_to_one_thread_and_is_given_back(work: Callable[[Progress], None]) -> None:
    def threads() -> int:
        return max(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")

    seen: list[int] = []
    with threadpool_limits(2):
        work(lambda what, done: seen.append(threads()))
        assert threads() == 2
    assert set(seen) == {1}
