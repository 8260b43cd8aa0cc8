"""TOML to validated settings; a refused key is named by its path, its allowed range and its nearest known name."""

from __future__ import annotations

import os
from typing import Any

from autotune.config.procedure import (
    ControllerSettings,
    DesignSettings,
    ExperimentSettings,
    LimitSettings,
    OperatingPointSettings,
    SignalSettings,
    VerificationSettings,
)
from autotune.config.rig import RigSettings
from autotune.schema import Section, Text, validated
from autotune.text_files import read_toml

__all__ = ["Config", "json_schema", "load_config", "validated"]


class Config(Section):
    """One complete file per rig and per use."""

    name: Text
    rig: RigSettings
    signals: SignalSettings
    limits: LimitSettings
    operating_point: OperatingPointSettings
    experiment: ExperimentSettings = ExperimentSettings()
    design: DesignSettings = DesignSettings()
    controller: ControllerSettings | None = None
    verification: VerificationSettings = VerificationSettings()


def load_config(path: str | os.PathLike[str]) -> Config:
    """Read and validate a configuration file.

    Raises
    ------
    InputError
        No such file, not TOML, or the first key that was refused: its path, the allowed range, the nearest known key.
    """
    return validated(Config, read_toml(path), str(path))


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the configuration, for editors that complete keys."""
    return Config.model_json_schema() | {"$schema": "https://json-schema.org/draft/2020-12/schema"}
