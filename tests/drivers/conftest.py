from __future__ import annotations

from pathlib import Path

import pytest

from tests.drivers.bench import certificates_by_the_book
from tests.drivers.firmware_build import build_uno


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return certificates_by_the_book(tmp_path_factory.mktemp("tls"))


@pytest.fixture(scope="session")
def uno_elf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_uno(tmp_path_factory.mktemp("uno"))
