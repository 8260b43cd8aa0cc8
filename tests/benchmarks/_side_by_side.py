"""Parts of a benchmark side by side, on the engine of the campaigns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from io import StringIO

from autotune.batch.engine import cluster, run_all

Part = Callable[[], None]


def printed(part: Part) -> str:
    """Return what a part prints."""
    with redirect_stdout(StringIO()) as out:
        part()
    return out.getvalue()


def print_all(parts: Sequence[Part], warm_up: Part) -> None:
    """Run the parts, as many at a time as there are processors, and print what they print in their own order.

    ``warm_up`` runs once here, where it compiles what is not on the disk yet, and once in every worker, so that no
    part's processor time has it.
    """
    warm_up()
    texts: dict[str, str] = {}
    shown = 0
    with cluster() as client:
        client.run(warm_up)
        for name, text in run_all(client, printed, {str(i): part for i, part in enumerate(parts)}, retries=0):
            if isinstance(text, Exception):
                raise text
            texts[name] = text
            while str(shown) in texts:
                print(texts.pop(str(shown)), end="", flush=True)
                shown += 1
