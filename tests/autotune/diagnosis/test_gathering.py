"""What recordings show with fewer effects: the largest hypothesis that has no others."""

from __future__ import annotations

from dataclasses import replace

import pytest

from autotune.diagnosis.chain_evidence import ChainEvidence
from autotune.diagnosis.findings import found_effects, left_open
from autotune.diagnosis.gathering import evidence_of
from autotune.diagnosis.selection.judged_chain import as_search
from autotune.diagnosis.thresholds import IN_USE
from autotune.diagnosis.verdict import judged
from autotune.effects import CATALOGUE
from autotune.progress import quiet
from tests.autotune.diagnosis.servo_rigs import servo_model, servo_recording

DRAG = "plant.quadratic_drag"


@pytest.fixture(scope="module")
def evidence() -> ChainEvidence:
    """Two recordings of a servo with a drag that its model lacks."""
    recordings = [servo_recording(seed, lambda x, v: -0.03 * v * abs(v)) for seed in (1, 2)]
    rest = [name for name in CATALOGUE if name not in (DRAG, "actuator.rate_limit")]
    return evidence_of(servo_model(), recordings, None, rest, quiet, IN_USE)


def test_an_effect_that_is_not_kept_is_missing_from_search_and_verdict(evidence: ChainEvidence) -> None:
    assert evidence.search.chosen.names == (DRAG,)
    assert judged(evidence) == "effect"
    assert judged(evidence.keeping({DRAG})) == "effect"
    without = evidence.keeping(set())
    assert without.search.chosen.names == ()
    friction, larger = "plant.coulomb_friction", "plant.stribeck_friction"
    said = {friction: 0.97, larger: 0.9, "actuator.lag": 0.2}
    shown = found_effects(evidence, "effect")[0]
    assert left_open([replace(shown, name=larger)], evidence, said)[0].endswith(": actuator.lag (0.20).")  # it has both
    assert friction in left_open([shown], evidence, said)[0]
    assert without.quality.extended == without.quality.retuned > evidence.quality.extended
    assert judged(without) == "unexplained"


def test_a_likely_effect_is_kept_though_the_leading_hypothesis_has_none(evidence: ChainEvidence) -> None:
    """What is in many hypotheses may be likelier than not where no one of them leads."""
    assert evidence.found is not None
    found = replace(evidence.found, chosen=evidence.found.retuned)
    leads = replace(evidence, found=found, search=as_search(found))
    assert leads.keeping({DRAG}).search.chosen.names == (DRAG,)
    assert leads.keeping(set()).search.chosen.names == ()
