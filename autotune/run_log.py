"""What a run tells while it goes, for whoever looks on: ``progress.jsonl``, one JSON object per change, appended.

The samples are in the recordings; this file says what they do not. Every line has an ``event``:

================  ====================================================================================================
``run``           name, units, limits, operating point and sample time: the configuration as far as an onlooker needs it
``recording``     name of a recording that begins now, beside this file
``progress``      state, elapsed and remaining rig time [s], message, relay, warnings; points once there are any
``analysis``      points, fitted plant and reduced model as transfer functions, the new controller
``verification``  measured and predicted step responses, decision and reason
``gains``         old and new gains, and which of them the rig holds
``waiting``       for how long the operator may decide otherwise [s]
``ended``         reason and exit status; missing while the run goes, and for ever where it was killed
================  ====================================================================================================
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from autotune.config import Config
from autotune.controller import PIDController
from autotune.errors import AutotuneError, ExperimentStopped, OperatorStop
from autotune.experiment.judgement import Verification, smooth_steps
from autotune.experiment.result import Status
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint, points_to_json
from autotune.whole_files import append_whole, jsonable

#: rows of a step response that are kept for a picture
PICTURE_ROWS = 400


class RunLog:
    """Appends to the file; each line is with the operating system before a method returns.

    Use it as a context manager: leaving it in any way says why the run ended.

    Parameters
    ----------
    path : path
        File to append to; a resumed run goes on in the same one.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 - closed by __exit__
        self._last: tuple[Any, ...] = ()
        self._exit_status = 0

    def begin(self, config: Config) -> None:
        """Say what is commissioned."""
        self._write(
            "run",
            config=config.model_dump(
                mode="json",
                include={"name": True, "signals": True, "limits": True, "operating_point": True, "rig": {"kind"}},
            ),
        )

    def recording(self, path: Path) -> Path:
        """Say that a recording begins, and return its path."""
        self._write("recording", file=path.name)
        return path

    def also(self, listener: Callable[[Status], None] | None) -> Callable[[Status], None]:
        """Return a listener that writes what has changed, then tells the given one."""

        def tell(status: Status) -> None:
            news = (status.state, status.message, status.points, status.relay, status.warnings)
            if news != self._last:
                self._last = news
                self._status(status)
            if listener is not None:
                listener(status)

        return tell

    def _status(self, status: Status) -> None:
        content = asdict(status) | {"points": points_to_json(status.points)}
        self._write("progress", **content)

    def say_analysis(
        self,
        points: tuple[FrequencyPoint, ...],
        plant: TransferFunction,
        reduced: TransferFunction | None,
        controller: PIDController,
    ) -> None:
        """Say what follows from the points.

        Parameters
        ----------
        points : tuple of FrequencyPoint
            What was measured.
        plant : TransferFunction
            Fitted to them.
        reduced : TransferFunction or None
            The reduced model, where there is one.
        controller : PIDController
            The design.
        """
        self._write(
            "analysis",
            points=points_to_json(points),
            plant=asdict(plant),
            reduced=asdict(reduced) if reduced is not None else None,
            controller=asdict(controller),
        )

    def say_verification(self, verification: Verification) -> None:
        """Say how the new loop behaves on the rig beside what was predicted."""
        self._exit_status = 0 if verification.accepted else ExperimentStopped.exit_status
        test, prediction = verification.test, verification.prediction
        usable = np.isfinite(verification.y)
        measured = smooth_steps(np.interp(test.t, test.t[usable], verification.y[usable]), test)
        thin = slice(None, None, max(1, test.t.size // PICTURE_ROWS))
        curves = {
            "t": test.t, "setpoint": test.setpoint, "measured": measured,
            "predicted": prediction.y, "low": prediction.low, "high": prediction.high,
        }  # fmt: skip
        self._write(
            "verification",
            accepted=verification.accepted,
            reason=verification.reason,
            steps={name: [float(f"{value:.5g}") for value in values[thin]] for name, values in curves.items()},
        )

    def gains(self, old: PIDController | None, new: PIDController, *, deployed: bool) -> None:
        """Say which gains there are, and whether the rig holds the new ones.

        Parameters
        ----------
        old : PIDController or None
            What the rig held before; None where that is not known.
        new : PIDController
            The design.
        deployed : bool
            Whether the rig holds it.
        """
        self._write("gains", old=asdict(old) if old is not None else None, new=asdict(new), deployed=deployed)

    def waiting(self, patience_s: float) -> None:
        """Say that the operator may decide otherwise for so long [s]."""
        self._write("waiting", patience_s=patience_s)

    def _write(self, event: str, **content: Any) -> None:
        line = json.dumps(jsonable({"event": event, **content}), allow_nan=False)
        with contextlib.suppress(OSError):  # a full disk ends the run at its next row, not at what is told of it
            append_whole(self._file, line.encode() + b"\n")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        match error:
            case None:
                self._write("ended", reason="completed", exit_status=self._exit_status)
            case AutotuneError():
                self._write("ended", reason=str(error), exit_status=error.exit_status)
            case KeyboardInterrupt():
                self._write("ended", reason="stopped by the operator", exit_status=OperatorStop.exit_status)
            case _:
                self._write("ended", reason=f"{type(error).__name__}: {error}", exit_status=1)
        self._file.close()
