"""The forward search by itself: no simulator, hypotheses whose errors on stretches are stated in a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.diagnosis.selection.search import Proposals, search
from autotune.progress import Progress, quiet
from tests.autotune.diagnosis.selection.on_stretches import Astray

DRY, GRAVITY, LAG = "plant.coulomb_friction", "plant.sine_torque", "actuator.lag"
Names = frozenset[str]


def stated(names: Names, error: float) -> Astray:
    squares = np.full(8, error**2)
    return Astray(names=tuple(sorted(names)), long_squares=squares, short_squares=squares, log_odds=0.0)


@dataclass(frozen=True)
class Table(Proposals[Astray]):
    """Errors by effects; what is not in the table runs away."""

    errors: Mapping[Names, float]
    nominal: Astray
    roots: tuple[Astray, ...]

    def _known(self, wanted: Sequence[Names]) -> list[Astray]:
        return [stated(names, self.errors[names]) for names in dict.fromkeys(wanted) if names in self.errors]

    def larger(self, beam: Sequence[Astray], progress: Progress) -> list[Astray]:
        """Return what has one effect more."""
        every = [frozenset(one.names) | {name} for one in beam for name in (DRY, GRAVITY, LAG) if name not in one.names]
        return self._known(every)

    def refitted(self, some: Sequence[Astray]) -> list[Astray]:
        """Return them as they are here."""
        return self._known([frozenset(one.names) for one in some])

    def smaller(self, some: Sequence[Astray], known: Sequence[Astray]) -> list[Astray]:
        """Return what has one effect fewer and is not known."""
        seen = {one.identity for one in known}
        return self._known([frozenset(one.names) - {n} for one in some for n in one.names
                            if frozenset(one.names) - {n} not in seen])  # fmt: skip

    def finish_leading(self, found: Sequence[Astray]) -> list[Astray]:
        """Return nothing: a stated error does not get smaller."""
        return []


def found_in(errors: Mapping[Names, float], known: Sequence[Astray] | None = None) -> set[str]:
    root = stated(frozenset(), 1.0)
    return set(search(Table(errors, root, (root,)), quiet, known).chosen.names)


def test_an_effect_is_added_where_it_takes_away_a_tenth_of_the_error_at_least() -> None:
    assert found_in({frozenset({DRY}): 0.5}) == {DRY}
    assert found_in({frozenset({DRY}): 0.5, frozenset({DRY, LAG}): 0.2}) == {DRY, LAG}


def test_a_pair_is_found_of_which_neither_does_anything_alone() -> None:
    errors = {frozenset({DRY}): 1.02, frozenset({GRAVITY}): 1.05, frozenset({DRY, GRAVITY}): 0.3}
    assert found_in(errors) == {DRY, GRAVITY}


def test_an_effect_that_only_led_to_others_is_left_out_again() -> None:
    """The lag stands for friction until gravity is there; then friction and gravity need no lag."""
    errors = {
        frozenset({LAG}): 0.7, frozenset({LAG, GRAVITY}): 0.5, frozenset({LAG, GRAVITY, DRY}): 0.2,
        frozenset({GRAVITY, DRY}): 0.19,
    }  # fmt: skip
    assert found_in(errors) == {GRAVITY, DRY}


def test_what_more_rows_found_is_judged_on_fewer_and_nothing_else_is() -> None:
    errors = {frozenset({DRY, GRAVITY}): 0.3, frozenset({LAG}): 0.2}
    assert found_in(errors) == {LAG}
    assert found_in(errors, known=[stated(frozenset({DRY, GRAVITY}), 0.5)]) == {DRY, GRAVITY}
    assert found_in(errors, known=[]) == set()
