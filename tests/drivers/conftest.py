from __future__ import annotations

from pathlib import Path

import pytest

from tests.drivers.bench import certificates_by_the_book
from tests.drivers.firmware_build import build_uno
from tests.drivers.iec_compiler import Blocks
from tests.drivers.operated_plc import SOURCE


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return certificates_by_the_book(tmp_path_factory.mktemp("tls"))


@pytest.fixture(scope="session")
def rig_blocks(tmp_path_factory: pytest.TempPathFactory) -> Blocks:
    """The shipped function blocks, compiled."""
    return Blocks(SOURCE, tmp_path_factory.mktemp("blocks"))


@pytest.fixture(scope="session")
def uno_elf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_uno(tmp_path_factory.mktemp("uno"))
