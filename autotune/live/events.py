"""Lines of ``progress.jsonl`` as typed events: what is not one of them is no event, whoever wrote it.

The file lies in a folder that others may have written, and what is in it is shown in a browser that holds Abort. So
every value is checked for its kind, its size and, for a recording, that it lies in the folder itself.
"""

from __future__ import annotations

import json
import math
import re
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator, model_validator

from autotune.controller import PIDController
from autotune.errors import InputError
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint, points_from_json
from autotune.schema import LARGEST, Number
from autotune.text_files import is_control

#: names that a run gives its recordings
RECORDING_NAME = re.compile(r"(recording|verification)(-[0-9]{1,6})?\.csv")
#: longest line that is an event [character]
LONGEST_LINE = 4 << 20

Words = Annotated[str, Field(max_length=2000)]
Coefficients = Annotated[tuple[float, ...], Field(min_length=1, max_length=100)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Signals(_Part):
    """Units and sample time."""

    sample_time_s: Annotated[float, Field(gt=0, le=LARGEST)] = 1.0
    u_unit: Words = ""
    y_unit: Words = ""


class Limits(_Part):
    """The safety envelope."""

    u_min: Number
    u_max: Number
    u_safe: Number
    y_min: Number
    y_max: Number
    swing: Annotated[float, Field(gt=0, le=LARGEST)]
    time_s: Number


class Centre(_Part):
    """The operating point."""

    y: Number


class RigKind(_Part):
    """What kind of rig it is; empty where nothing says."""

    kind: Words = ""


class Told(_Part):
    """The configuration as far as an onlooker needs it."""

    name: Words
    rig: RigKind = RigKind()
    signals: Signals
    limits: Limits
    operating_point: Centre


class Gains(_Part):
    """A PI or PID; no integral time is an infinite one."""

    K: Number
    Ti_s: Number | None
    Td_s: Number = 0.0
    Tf_s: Number = 0.0
    setpoint_weight: Number = 1.0

    def controller(self) -> PIDController:
        """Return the controller."""
        return PIDController(**self.model_dump() | {"Ti_s": math.inf if self.Ti_s is None else self.Ti_s})


class Plant(_Part):
    """A transfer function."""

    num: Coefficients
    den: Coefficients
    delay_s: Annotated[float, Field(ge=0, le=LARGEST)]

    @model_validator(mode="after")
    def _exists(self) -> Plant:
        try:
            self.transfer_function()
        except InputError as error:
            raise ValueError(error.what) from None
        return self

    def transfer_function(self) -> TransferFunction:
        """Return it."""
        return TransferFunction(num=self.num, den=self.den, delay_s=self.delay_s)


class _WithPoints(_Part):
    points: Annotated[tuple[Any, ...], Field(max_length=1000)] = ()

    @field_validator("points")
    @classmethod
    def _are_points(cls, given: tuple[Any, ...]) -> tuple[FrequencyPoint, ...]:
        try:
            return points_from_json(given, "points")
        except InputError as error:
            raise ValueError(error.what) from None


class Relay(_Part):
    """The relay that runs."""

    midpoint: Number
    amplitude: Number
    hysteresis: Number
    delay_samples: Number
    smoothing: Number
    plant_sign: Literal[-1, 0, 1]


class RunBegins(_Part):
    """What is commissioned."""

    event: Literal["run"]
    config: Told


class RecordingBegins(_Part):
    """A recording begins, in the folder of the run."""

    event: Literal["recording"]
    file: Annotated[str, Field(max_length=60)]

    @field_validator("file")
    @classmethod
    def _lies_here(cls, given: str) -> str:
        if not RECORDING_NAME.fullmatch(given):
            raise ValueError("not a recording of a run")
        return given


class InProgress(_WithPoints):
    """Where the procedure is."""

    event: Literal["progress"]
    state: Annotated[str, Field(max_length=80)]
    elapsed_s: Number
    remaining_s: Number | None
    message: Words
    relay: Relay | None = None
    warnings: Annotated[tuple[Words, ...], Field(max_length=100)] = ()


class Analysed(_WithPoints):
    """What follows from the points."""

    event: Literal["analysis"]
    plant: Plant
    reduced: Plant | None
    controller: Gains


class Verified(_Part):
    """How the new loop behaves beside what was predicted."""

    event: Literal["verification"]
    accepted: bool
    reason: Words
    steps: dict[
        Literal["t", "setpoint", "measured", "predicted", "low", "high"],
        Annotated[tuple[float | None, ...], Field(min_length=1, max_length=10_000)],
    ]

    @model_validator(mode="after")
    def _are_curves(self) -> Verified:
        if len(self.steps) != 6 or len({len(curve) for curve in self.steps.values()}) != 1:
            raise ValueError("six curves of the same length")
        if None in self.steps["t"]:
            raise ValueError("a time is missing")
        return self


class GainsKnown(_Part):
    """Old and new gains, and which of them the rig holds."""

    event: Literal["gains"]
    old: Gains | None
    new: Gains
    deployed: bool


class Waiting(_Part):
    """For how long the operator may decide otherwise."""

    event: Literal["waiting"]
    patience_s: Annotated[float, Field(ge=0, le=86400)]


class Ended(_Part):
    """Why the run ended."""

    event: Literal["ended"]
    reason: Words


Event: TypeAlias = RunBegins | RecordingBegins | InProgress | Analysed | Verified | GainsKnown | Waiting | Ended

_EVENT: TypeAdapter[Event] = TypeAdapter(Annotated[Event, Field(discriminator="event")])


def read_event(line: str) -> Event | None:
    """Return the event that a line is, None where it is none."""
    if len(line) > LONGEST_LINE or any(map(is_control, line)):
        return None
    try:
        content = json.loads(line)
        if any(map(is_control, _texts(content))):
            return None
        return _EVENT.validate_python(content)
    except (ValidationError, ValueError, RecursionError, OverflowError):
        return None


def _texts(content: Any) -> str:
    """Return all text of an event in one."""
    match content:
        case str():
            return content
        case dict():
            return "".join(_texts(part) for part in content.values())
        case list():
            return "".join(_texts(part) for part in content if isinstance(part, str | dict | list))
    return ""
