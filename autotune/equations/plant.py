"""Equations as a simulated rig: a plant that lives in its own time, for rehearsals on a person's own simulation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.equations.effects import apply
from autotune.equations.linearise import linearise, transfer_function
from autotune.equations.model import EquationModel
from autotune.equations.simulate import Drive, compile_model, derivatives, simulate
from autotune.equations.starts import rest_state
from autotune.errors import InputError


class EquationPlant:
    """A plant made of equations with their effects; it offers what the project's own simulated plants offer.

    Parameters
    ----------
    model : EquationModel
        The equations.
    seed : int
        Draws the noise.
    noise : float
        Half-width of the uniform noise on y [y unit].
    others : mapping of column to float
        What measured inputs beside the command stand at; 0 for those not named.
    u_start : float
        Command at which it rests when it begins to live.
    y_start : float
        Reading at which it rests; NaN where the command decides that.
    """

    def __init__(
        self,
        model: EquationModel,
        *,
        seed: int = 0,
        noise: float = 0.0,
        others: Mapping[str, float] | None = None,
        u_start: float = 0.0,
        y_start: float = float("nan"),
    ) -> None:
        applied = apply(model)
        self._model, self._applied = model, applied
        self._compiled = compile_model(model, applied.extensions)
        self._p = self._compiled.parameter_vector
        self._random, self._noise = np.random.default_rng(seed), noise
        given = others or {}
        self._inputs = np.array([given.get(c, 0.0) for c in model.columns])
        self._inputs[0] = u_start
        self._u_rest, self._y_rest = u_start, y_start
        self._state = rest_state(self._compiled, self._p, self._inputs, y_start)
        self._time_s = 0.0
        # commands that are still on their way through the longest dead time
        self._late_s = float(np.max(applied.delays, initial=0.0))
        self._past: list[tuple[float, FloatArray]] = [(-np.inf, self._inputs.copy())]

    @property
    def time_s(self) -> float:
        """Time the plant has lived [s]."""
        return self._time_s

    @property
    def u_applied(self) -> float:
        """Command it holds [u unit]."""
        return float(self._inputs[0])

    @property
    def u_rest(self) -> float:
        """Truth: command at which it rested at the start [u unit]."""
        return self._u_rest

    @property
    def y_true(self) -> float:
        """Truth: the reading before noise [y unit]."""
        _, outputs = derivatives(self._compiled, self._p, self._state[None, :], self._inputs[None, :], self._time_s)
        return float(self._applied.after(outputs[:, 0])[0])

    def advance(self, u: float, dt_s: float) -> None:
        """Hold the command ``u`` [u unit] for ``dt_s`` [s].

        Raises
        ------
        InputError
            The simulation runs away.
        """
        if dt_s <= 0.0:
            return
        self._inputs[0] = u
        self._past.append((self._time_s, self._inputs.copy()))
        end = self._time_s + dt_s
        rows = [one for one in self._past if one[0] > self._time_s - self._late_s - dt_s]
        before = [one for one in self._past if one[0] <= self._time_s - self._late_s - dt_s][-1:]
        kept = [*before, *rows]
        self._past = kept
        t = np.array([max(one[0], self._time_s - self._late_s - 2.0 * dt_s - 1.0) for one in kept] + [end])
        inputs = np.array([one[1] for one in kept] + [kept[-1][1]])
        keep = np.append(np.diff(t) > 0.0, True)
        drive = self._applied.before(Drive(t=t[keep], inputs=inputs[keep]))
        first = int(np.searchsorted(drive.t, self._time_s))
        run = simulate(
            self._compiled, self._p, drive, self._state[None, :], starts=np.array([first]),
            stops=np.array([drive.t.size - 1]), delays=self._applied.delays,
        )  # fmt: skip
        if not run.is_complete:
            raise InputError(f"the simulation runs away at {self._time_s:g} s", where=self._model.name,
                             remedy="check signs, or narrow the limits")  # fmt: skip
        self._state, self._time_s = run.ends[0], end

    def measure(self) -> float:
        """Return one measurement [y unit]; every call draws new noise."""
        return self.y_true + float(self._random.uniform(-self._noise, self._noise)) if self._noise else self.y_true

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Truth: small-signal complex gain from command to reading at the starting rest."""
        inputs = self._inputs.copy()
        inputs[0] = self._u_rest
        return transfer_function(linearise(self._model, inputs, self._y_rest)).response(omega_rad_s)
