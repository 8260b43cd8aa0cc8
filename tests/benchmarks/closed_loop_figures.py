"""Figures 2 to 5 of Pouliquen et al. 2011 with the benchmark's own settings of every method.

``FIGURES=folder python -m tests.benchmarks closed_loop_figures`` writes ``folder/closed_loop_figures.html`` from 100
data sets of the paper's example (SETS in the environment for another number), with the default estimate beside them.
"""

from __future__ import annotations

import os
from pathlib import Path

from autotune.errors import IdentificationError
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.report.loop_figures import loop_page
from autotune.report.page import write_page
from tests.benchmarks.closed_loop import METHODS
from tests.loop_example import PLANT, example_set

#: Methods drawn: title, entry of the benchmark's table.
DRAWN = {
    "this paper": "paper's method, n_cl = 9",
    "Van Overschee-De Moor": "Van Overschee-De Moor 10/10",
    "Oku-Tanaka": "Oku-Tanaka 20/20",
    "SSARX": "SSARX p=30 f=10",
    "ORT": "ORT (Katayama) 20/20",
    "default": "default (polished)",
}


def estimates(count: int) -> dict[str, list[InnovationModel]]:
    """Return the models of every drawn method on the same data sets; those without a model are left out."""
    models: dict[str, list[InnovationModel]] = {title: [] for title in DRAWN}
    for seed in range(count):
        d = example_set(seed)
        for title, name in DRAWN.items():
            try:
                models[title].append(METHODS[name](d))
            except IdentificationError:
                continue
    return models


def main() -> None:
    target = os.environ.get("FIGURES")
    if not target:
        print("figures 2 to 5 of Pouliquen et al. 2011: FIGURES=folder names where to draw them")
        return
    count = int(os.environ.get("SETS", "100"))
    models = estimates(count)
    Path(target).mkdir(parents=True, exist_ok=True)
    path = Path(target) / "closed_loop_figures.html"
    write_page(loop_page(models, PLANT, count), path)
    for title, found in models.items():
        print(f"{title:24s} {len(found)} models of {count} sets")
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
