"""A plant from a model file: a rig's twin that is the rig's own kind, to rehearse on."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from scipy.optimize import root

from autotune.arrays import ComplexArray, FloatArray
from autotune.config.twin import PlantSettings
from autotune.equations.black_box import BlackBox
from autotune.equations.chain import from_chain
from autotune.equations.files import read_any_model
from autotune.equations.linearise import linearise, transfer_function
from autotune.equations.model import EquationModel
from autotune.equations.rest import typical_sizes
from autotune.equations.simulate import Drive, compile_model, derivatives, require_complete, simulate
from autotune.errors import InputError
from autotune.models import Model

#: slope, in sizes of the states in the time of the fastest, below which a plant is at rest
_AT_REST = 1e-9


def model_plant(settings: PlantSettings, path: str, *, u_start: float) -> ModelPlant:
    """Return the plant of a model file.

    Parameters
    ----------
    settings : PlantSettings
        Noise, resolution and seed of its sensor.
    path : str
        The model file.
    u_start : float
        Command under which it rests at first [u unit].

    Raises
    ------
    InputError
        The model file cannot be read, or has what a twin does not take along.
    """
    model = read_any_model(path)
    if isinstance(model, BlackBox):
        raise InputError("an FMU as a twin", where=path, remedy="give its equations, or a chain of blocks")
    if model.effects:
        raise InputError(
            f"{len(model.effects)} [[effect]] of a diagnosis, which a twin does not take along",
            where=path,
            remedy="name the model without them, or write them as equations",
        )
    equations = from_chain(model) if isinstance(model, Model) else model
    return ModelPlant(
        equations,
        u_start=u_start,
        noise=settings.noise or 0.0,
        resolution=settings.resolution or 0.0,
        seed=settings.seed,
    )


class ModelPlant:
    """A plant that lives by the equations of a model; see :class:`sim.plant.Plant`.

    Parameters
    ----------
    model : EquationModel
        The first input is the command; further ones stay at what the model takes from them.
    u_start : float
        Command under which it is at rest at the start; where there is no such rest (an integrating plant) it starts at
        the model's own offset of the command, and its states at their starts, 0 where the model says none.
    noise : float
        Half-width of the uniform noise of a measurement [y unit].
    resolution : float
        Step of the converter that measures [y unit]; 0 for none.
    seed : int
        Draws the noise.
    """

    def __init__(
        self, model: EquationModel, *, u_start: float, noise: float = 0.0, resolution: float = 0.0, seed: int = 0
    ) -> None:
        self._model = model
        self._compiled = compile_model(model)
        self._parameters = self._compiled.parameter_vector
        self._others = [one.offset for one in model.inputs[1:]]
        self._noise, self._resolution = noise, resolution
        self._random = np.random.default_rng((seed, 2))
        self.time_s = 0.0
        given = np.array([0.0 if state.start is None else state.start for state in model.states])
        self.u_rest = model.inputs[0].offset
        rest = self._rest(u_start, given)
        self._states = given if rest is None else rest
        self.u_applied = self.u_rest if rest is None else u_start
        self._delay_s = model.inputs[0].delay_s
        # when each command began to be held; the first for ever before
        self._held: deque[tuple[float, float]] = deque([(-math.inf, self.u_applied)])

    @property
    def y_true(self) -> float:
        """Truth: the output before noise [y unit]."""
        return self._look(self._states, self._acting(self.time_s))[1]

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command for a time.

        Parameters
        ----------
        u : float
            Command that is held [u unit].
        dt_s : float
            How long [s].

        Raises
        ------
        InputError
            The model runs away.
        """
        if u != self.u_applied:
            self._held.append((self.time_s, u))
            self.u_applied = u
        end_s = self.time_s + dt_s
        while self.time_s < end_s:
            # until the next command has come through the dead time
            turns = (since_s + self._delay_s for since_s, _ in self._held)
            until_s = min((at for at in turns if at > self.time_s), default=math.inf)
            self._run(self._acting(self.time_s), min(until_s, end_s))
        while len(self._held) > 1 and self._held[1][0] + self._delay_s <= self.time_s:
            self._held.popleft()

    def measure(self) -> float:
        """Return one measurement [y unit]; every call draws new noise."""
        y = self.y_true + self._noise * float(self._random.uniform(-1.0, 1.0))
        return self._resolution * round(y / self._resolution) if self._resolution else y

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Truth: complex gain at rest under the command, same shape as ``omega_rad_s``; integrating: at the output."""
        inputs = np.array([self._acting(self.time_s), *self._others])
        try:
            at = linearise(self._model, inputs)
        except InputError:
            at = linearise(self._model, inputs, self.y_true)
        return transfer_function(at).response(omega_rad_s)

    def _acting(self, at_s: float) -> float:
        """Return the command that has come through the dead time."""
        return next(u for since_s, u in reversed(self._held) if since_s + self._delay_s <= at_s)

    def _run(self, u: float, until_s: float) -> None:
        inputs = np.array([[u, *self._others]] * 2)
        drive = Drive(t=np.array([self.time_s, until_s]), inputs=inputs)
        if not drive.t[1] > drive.t[0]:
            return
        run = simulate(self._compiled, self._parameters, drive, self._states, delays=np.zeros(len(self._model.inputs)))
        self._states = require_complete(run, self._compiled, "twin").ends[0]
        self.time_s = until_s

    def _look(self, states: FloatArray, u: float) -> tuple[FloatArray, float]:
        slopes, outputs = derivatives(
            self._compiled, self._parameters, states[None, :], np.array([[u, *self._others]]), self.time_s
        )
        return slopes[0], float(outputs[0, 0])

    def _rest(self, u: float, given: FloatArray) -> FloatArray | None:
        """Return the states at rest under a command, None where there is no such rest."""
        if not given.size:
            return given
        inputs = np.array([u, *self._others])
        with np.errstate(all="ignore"):
            sizes, time_s = typical_sizes(self._compiled, self._parameters, inputs, given)
            sizes = np.where(sizes > 0.0, sizes, 1.0)

            def slopes(z: FloatArray) -> FloatArray:
                return self._look(given + sizes * z, u)[0] * (time_s / sizes)

            z = np.asarray(root(slopes, np.zeros(given.size)).x, dtype=np.float64)
            largest, slope = float(np.max(np.abs(z))), float(np.max(np.abs(slopes(z))))
        return given + sizes * z if math.isfinite(largest) and slope <= _AT_REST * max(1.0, largest) else None
