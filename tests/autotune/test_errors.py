"""Errors keep what they say on their way from one process to another."""

from __future__ import annotations

import pickle

import pytest

from autotune.errors import AutotuneError, DesignError, ExperimentStopped, IdentificationError, InputError, LinkError


@pytest.mark.parametrize(
    "kind", [AutotuneError, InputError, IdentificationError, DesignError, ExperimentStopped, LinkError]
)
def test_an_error_comes_out_of_another_process_as_it_went_in(kind: type[AutotuneError]) -> None:
    error = kind("no row", where="rec.csv", remedy="record one")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert str(again) == str(error) == "rec.csv: no row; record one"
    assert again.exit_status == error.exit_status
