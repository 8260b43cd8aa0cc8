"""Configuration: one TOML file drives everything; every key has its unit, its bounds and its default in the schema."""

from autotune.config.loader import Config, json_schema, load_config, validate

__all__ = ["Config", "json_schema", "load_config", "validate"]
