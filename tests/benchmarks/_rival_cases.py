"""Cases that all rivals are given: the same model, recordings and recording kept back, on the same terms."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim.proof import Campaign, conceal

#: Where recordings of real rigs with answers are looked for.
REAL = Path(os.environ.get("AUTOTUNE_REAL_CASES", Path(__file__).parents[3] / "shared" / "real_cases"))
#: A gap is asked for where the best linear model errs by this much more than the best known one.
WORTH_CLOSING = 1.15


@dataclass(frozen=True, kw_only=True)
class Case:
    """One case: files, how its forecast is judged, what counts as right, errors between which a gap is closed.

    ``horizon_s`` is None for one free run; ``linear`` and ``best`` are None where no gap is asked for.
    """

    name: str
    model: Path
    given: tuple[Path, ...]
    kept_back: tuple[Path, ...]
    horizon_s: float | None
    score_from_s: float
    right: frozenset[str]
    tolerated: frozenset[str] = field(default_factory=frozenset)
    linear: float | None = None
    best: float | None = None

    @property
    def conceals(self) -> bool:
        """Whether there is an effect to name."""
        return bool(self.right)

    def false(self, names: Sequence[str]) -> bool:
        """Whether a name is said that is neither right nor tolerated."""
        return bool(set(names) - self.right - self.tolerated)

    def gap(self, error: float) -> float:
        """Share of the gap from the best linear model to the best known one that an error closes, -1 at the least."""
        assert self.linear is not None
        assert self.best is not None
        return max((self.linear - error) / (self.linear - self.best), -1.0) if np.isfinite(error) else -1.0


def concealed(out: Path, count: int) -> list[Case]:
    """Make simulated cases of the proof, and return those that a diagnosis is given."""
    campaign = Campaign(out=out, seeds=range(100_000, 100_000 + count), tool=())
    return [_simulated(campaign, seed) for seed in conceal(campaign)]


def _simulated(campaign: Campaign, seed: int) -> Case:
    folder, answer = campaign.case(seed), json.loads(campaign.answer(seed).read_text(encoding="utf-8"))
    errors = answer["nrmse_unseen"] if answer["improvable"] else {}
    return Case(
        name=f"simulated_{seed}",
        model=folder / "model.toml",
        given=(folder / "rec1.csv", folder / "rec2.csv"),
        kept_back=(folder / "unseen.csv",),
        horizon_s=answer["horizon"],
        score_from_s=2.0 * answer["horizon"],
        right=frozenset(name for effect in answer["effects"] for name in effect["accept"]),
        tolerated=frozenset(answer["nuisance"]),
        linear=errors.get("retuned"),
        best=errors.get("noise"),
    )


def real() -> list[Case]:
    """Return the cases of real rigs, none where there are no recordings beside the checkout."""
    answers = REAL / "answers.json"
    if not answers.exists():
        return []
    return [_recorded(one) for one in json.loads(answers.read_text(encoding="utf-8"))["cases"]]


def _recorded(one: dict[str, Any]) -> Case:
    folder, errors = REAL / one["id"], one["nrmse"]
    linear = min(errors["nominal_toml"], errors.get("retuned_linear") or np.inf)
    asked = one["accept"] and linear > WORTH_CLOSING * errors["best_greybox"]
    return Case(
        name=one["id"],
        model=folder / one["model"],
        given=tuple(folder / name for name in one["fit"]),
        kept_back=tuple(folder / name for name in one["test"]),
        horizon_s=one["horizon_s"],
        score_from_s=one["score_from_s"],
        right=frozenset(name for group in one["accept"] for name in group),
        tolerated=frozenset(one["tolerated"]),
        linear=linear if asked else None,
        best=errors["best_greybox"] if asked else None,
    )
