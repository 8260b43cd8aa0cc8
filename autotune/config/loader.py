"""TOML to validated settings; a refused key is named by its path, its allowed range and its nearest known name."""

from __future__ import annotations

import math
import os
from typing import Annotated, Any

from pydantic import Field, model_validator

from autotune.config.gains import beyond_ranges
from autotune.config.procedure import (
    ApprovalSettings,
    ControllerSettings,
    DesignSettings,
    ExperimentSettings,
    LimitSettings,
    OperatingPointSettings,
    SignalSettings,
    VerificationSettings,
)
from autotune.config.registers import RegisterMap, RegisterSettings
from autotune.config.rig import RigSettings
from autotune.schema import Section, Text, validate
from autotune.text_files import read_toml

__all__ = ["Config", "json_schema", "load_config", "validate"]


#: Samples that a sweep has at least.
LEAST_SAMPLES = 100
#: Step of a command over its range, below which it is none: converters and registers have 32 bits at most.
FINEST = 1e-12


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
    approval: ApprovalSettings | None = None
    audit_log: Annotated[
        Text | None,
        Field(
            description="file that each change of the rig's gains is appended to; default: audit.jsonl by the journal"
        ),
    ] = None

    @model_validator(mode="after")
    def _on_the_grid(self) -> Config:
        """Cut the limits inwards to what the command's register can hold, and command in its steps."""
        registers = getattr(self.rig, "registers", None)
        if isinstance(registers, RegisterMap):
            cut = _limits_in_register(self.limits, registers.u)
            step = registers.u.step
            is_multiple = step and math.isclose(registers.u.offset / step, round(registers.u.offset / step))
            signals = self.signals
            if not signals.u_step and is_multiple:
                signals = signals.model_copy(update={"u_step": step})
            for name, value in (("limits", cut), ("signals", signals)):
                object.__setattr__(self, name, value)  # frozen, and not handed out yet
        return self

    @model_validator(mode="after")
    def _has_room(self) -> Config:
        limits, at = self.limits, self.operating_point
        if not limits.u_min < at.u_guess < limits.u_max:
            raise ValueError(
                f"operating_point.u_guess = {at.u_guess:g} must lie between limits.u_min and u_max, for a relay moves"
                " the command both ways"
            )
        if not limits.y_min < at.y < limits.y_max:
            raise ValueError(f"operating_point.y = {at.y:g} must lie between limits.y_min and y_max")
        step, room = self.signals.u_step, limits.u_max - limits.u_min
        if step and not FINEST * room <= step <= room:
            raise ValueError(
                f"signals.u_step = {step:g} is no step of a command between {limits.u_min:g} and {limits.u_max:g}; "
                "give the converter's, or 0 for any value"
            )
        return self

    @model_validator(mode="after")
    def _has_noise_of_its_range(self) -> Config:
        room = self.limits.y_max - self.limits.y_min
        for key, plant in (("rig", self.rig), ("rig.twin", getattr(self.rig, "twin", None))):
            noise = getattr(plant, "noise", None)
            if noise is not None and noise > room:
                raise ValueError(
                    f"{key}.noise = {noise:g} is more than the {room:g} between limits.y_min and y_max: a sensor that"
                    " shows nothing; give its half-width in the unit of y"
                )
        return self

    @model_validator(mode="after")
    def _has_time(self) -> Config:
        budget_s, sample_s = self.experiment.budget_s, self.signals.sample_time_s
        if budget_s < LEAST_SAMPLES * sample_s:
            raise ValueError(
                f"experiment.budget_s = {budget_s:g} is less than {LEAST_SAMPLES} samples of {sample_s:g} s: nothing"
                f" swings in that time; give at least {LEAST_SAMPLES * sample_s:g}, and some periods of the rig"
            )
        return self

    @model_validator(mode="after")
    def _has_gains_of_its_ranges(self) -> Config:
        now = self.controller
        if now is not None and (odd := beyond_ranges(now.K, now.Ti_s, self.limits, self.signals.sample_time_s)):
            raise ValueError(f"controller: {odd}; check the units of the gains")
        return self

    @model_validator(mode="after")
    def _no_faster_than_the_program(self) -> Config:
        scan_s, sample_s = getattr(self.rig, "scan_time_s", None), self.signals.sample_time_s
        if scan_s is not None and sample_s < scan_s:
            raise ValueError(
                f"signals.sample_time_s = {sample_s:g} is below rig.scan_time_s = {scan_s:g}: the device's program"
                " would pass over commands and show a measurement twice; sample no faster than it runs"
            )
        return self


def _limits_in_register(limits: LimitSettings, register: RegisterSettings) -> LimitSettings:
    try:
        u_min, u_max = register.inwards(limits.u_min, limits.u_max)
    except ValueError as error:
        raise ValueError(f"limits.u_min..u_max: {error}") from None
    u_safe = min(max(limits.u_safe, u_min), u_max)
    if register.step:
        count = round((u_safe - register.offset) / register.scale)
        at = (register.scale * (count + by) + register.offset for by in (0, -1, 1))
        u_safe = min((u for u in at if u_min <= u <= u_max), key=lambda u: abs(u - limits.u_safe), default=u_safe)
    if abs(u_safe - limits.u_safe) > 0.01 * (limits.u_max - limits.u_min):
        raise ValueError(
            f"limits.u_safe = {limits.u_safe:g}: in the register's steps of {register.step:g} the nearest value within"
            f" the limits is {u_safe:g}; give that if the rig may be left with it, or a register with a finer scale"
        )
    if abs(u_safe - limits.u_safe) <= 1e-6 * register.step:
        u_safe = limits.u_safe
    return limits.model_copy(update={"u_min": u_min, "u_max": u_max, "u_safe": u_safe})


def load_config(path: str | os.PathLike[str]) -> Config:
    """Read and validate a configuration file.

    Raises
    ------
    InputError
        No such file, not TOML, or the first key that was refused: its path, the allowed range, the nearest known key.
    """
    return validate(Config, read_toml(path), str(path))


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the configuration, for editors that complete keys."""
    return Config.model_json_schema() | {"$schema": "https://json-schema.org/draft/2020-12/schema"}
