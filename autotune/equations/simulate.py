"""Simulation of equations: a compiled model, what drives it, and its outputs at a recording's rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.equations import kernel
from autotune.equations.expressions import Call, Name
from autotune.equations.model import EquationModel, Extension, ModelParameter
from autotune.equations.native import Translator
from autotune.equations.samples import lag_signal
from autotune.equations.tape import Program, translate
from autotune.errors import InputError
from autotune.recording import Recording

#: Local error of a step, of the largest magnitude that the state has had so far in its window.
TOLERANCE = 1e-6
#: Machine code of models that are simulated often, shared by all threads.
_TRANSLATOR = Translator()


@dataclass(frozen=True, kw_only=True, eq=False)
class Held:
    """What an effect does to an input before it drives the equations.

    Attributes
    ----------
    column : int
        Which of the model's inputs.
    parameter : ModelParameter
        The effect's number, which a fit may move like those of the equations.
    transform : callable of time stamps, held values and the number, optional
        What becomes of the held values; without it the number is a dead time [s].
    """

    column: int
    parameter: ModelParameter
    transform: Callable[[FloatArray, FloatArray, float], FloatArray] | None = None


@dataclass(frozen=True, kw_only=True)
class Lag:
    """A state of an extension that is a recorded column behind a lag: the column's past tells it at every row.

    Attributes
    ----------
    state, column, parameter : int
        Of the program's states, of the model's inputs, and of the parameters: its time constant.
    """

    state: int
    column: int
    parameter: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Compiled:
    """A model with its extensions, ready to be driven.

    Attributes
    ----------
    model : EquationModel
        The model.
    extensions : tuple of Extension
        What was added to it.
    program : Program
        The tape.
    parameters : tuple of ModelParameter
        Parameters of the model, then those of the extensions, then those of what is done to inputs: the order of every
        parameter vector.
    signals : tuple of str
        Outputs beside y.
    held : tuple of Held
        What is done to inputs before they drive the equations, in this order.
    lags : tuple of Lag
        States whose start no window may choose, since recorded columns tell it.
    most_steps : float
        Steps between two rows, on average, that a simulation may take.
    spare_steps : float
        Steps of a window that may be taken ahead of that average, for a few hard places.
    """

    model: EquationModel
    extensions: tuple[Extension, ...]
    program: Program
    parameters: tuple[ModelParameter, ...]
    signals: tuple[str, ...] = ()
    held: tuple[Held, ...] = ()
    lags: tuple[Lag, ...] = ()
    most_steps: float = kernel.MOST_ON_AVERAGE
    spare_steps: float = kernel.SPARE_STEPS

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, those of extensions last."""
        return self.program.states

    @property
    def parameter_vector(self) -> FloatArray:
        """Nominal parameter values."""
        return np.array([p.value for p in self.parameters], dtype=np.float64)

    @property
    def delays(self) -> FloatArray:
        """Dead time of each input [s]."""
        return np.array([one.delay_s for one in self.model.inputs], dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """What drives a simulation: (N,) time stamps and (N, m) inputs, one column per input of the model."""

    t: FloatArray
    inputs: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """What a simulation gave.

    Attributes
    ----------
    outputs : (N, 1 + signals) array
        y and the signals at each row; NaN outside the windows and after a window that ended early.
    ends : (W, n) array
        State at each window's stop row, or at the last row.
    reasons : (W,) int array
        ``kernel.DONE``, ``NOT_A_NUMBER`` or ``TOO_MANY_STEPS``.
    until_s : (W,) array
        Time stamp up to which a window ran, where it ended early.
    steps : (W,) array
        Steps that a window took, those that were tried in vain too.
    """

    outputs: FloatArray
    ends: FloatArray
    reasons: IntArray
    until_s: FloatArray
    steps: FloatArray

    @property
    def y(self) -> FloatArray:
        """The simulated readings, (N,)."""
        return np.asarray(self.outputs[:, 0])

    @property
    def is_complete(self) -> bool:
        """Whether every window ran to its end."""
        return bool(np.all(self.reasons == kernel.DONE))


def compile_model(
    model: EquationModel, extensions: Sequence[Extension] = (), signals: Sequence[str] = (), held: Sequence[Held] = ()
) -> Compiled:
    """Translate a model with what is added to it; takes about a millisecond.

    Parameters
    ----------
    model : EquationModel
        The model; its ``effects`` are not looked at.
    extensions : sequence of Extension
        What is added, in the order in which a signal meets it.
    signals : sequence of str
        Expressions that are wanted at the rows beside y.
    held : sequence of Held
        What is done to inputs before they drive the equations.

    Returns
    -------
    Compiled
        Ready for :func:`simulate`.

    Raises
    ------
    InputError
        An extension that does not fit, or an unknown name.
    """
    program = translate(model, extensions, signals)
    parameters = (*model.parameters, *(p for e in extensions for p in e.parameters), *(one.parameter for one in held))
    return Compiled(
        model=model, extensions=tuple(extensions), program=program, parameters=parameters, signals=tuple(signals),
        held=tuple(held), lags=_lags(model, extensions, program, [p.name for p in parameters]),
    )  # fmt: skip


def _lags(
    model: EquationModel, extensions: Sequence[Extension], program: Program, parameters: Sequence[str]
) -> tuple[Lag, ...]:
    """Return the states of extensions whose derivative is (a recorded column less the state) over a parameter."""
    found = []
    for one in (state for extension in extensions for state in extension.states):
        match one.derivative:
            case Call("/", (Call("-", (Name(column), Name(own))), Name(constant))) if own == one.name:
                if column in model.columns and constant in parameters:
                    at = program.states.index(own), model.columns.index(column), parameters.index(constant)
                    found.append(Lag(state=at[0], column=at[1], parameter=at[2]))
    return tuple(found)


def drive_of(model: EquationModel, recording: Recording) -> Drive:
    """Return what a recording drives a model with.

    Parameters
    ----------
    model : EquationModel
        Names its m columns.
    recording : Recording
        N rows.

    Returns
    -------
    Drive
        Stamps, (N,), and inputs, (N, m).

    Raises
    ------
    InputError
        A column that the recording lacks, or one with values that are no numbers.
    """
    columns = [recording[one.column] for one in model.inputs]
    recording.require_finite(model.columns)
    inputs = np.column_stack(columns) if columns else np.zeros((len(recording), 0))
    return Drive(t=np.ascontiguousarray(recording.t), inputs=np.ascontiguousarray(inputs, dtype=np.float64))


def simulate(
    compiled: Compiled,
    parameters: FloatArray,
    drive: Drive,
    start_states: FloatArray,
    *,
    starts: IntArray | None = None,
    stops: IntArray | None = None,
    delays: FloatArray | None = None,
    tolerance: float = TOLERANCE,
) -> Run:
    """Simulate windows of a recording's rows.

    Parameters
    ----------
    compiled : Compiled
        The model and what was added to it.
    parameters : (P,) array
        Parameters, in the order of ``compiled.parameters``.
    drive : Drive
        Time stamps and inputs. Transforms of samples (a quantiser, a shuffled clock) are applied to these arrays.
    start_states : (W, n) array
        State at each window's first row, in the order of ``compiled.states``; of ``compiled.lags`` it is not looked at.
    starts, stops : (W,) int arrays, optional
        Rows where windows start and before which they end; by default one window over all rows, or each to the next.
    delays : (m,) array, optional
        Dead time of each input [s], in place of the model's and of what is done to inputs.
    tolerance : float
        Local error of a step relative to the largest magnitude that a state has had; crossings of switched terms are
        located to 1e-9 of the time between rows.

    Returns
    -------
    Run
        Outputs and end states. A window that runs away is NaN from there on; it is no error here.

    Notes
    -----
    y at a row sees the inputs as they were before that row's command acts. ``t`` counts from the drive's first row.
    """
    parameters, drive, late = _arriving(compiled, parameters, drive)
    program, rows = compiled.program, drive.t.size
    states = np.ascontiguousarray(np.atleast_2d(np.asarray(start_states, dtype=np.float64)))
    first = np.zeros(1, dtype=np.int64) if starts is None else np.asarray(starts, dtype=np.int64)
    last = np.append(first[1:], rows) if stops is None else np.asarray(stops, dtype=np.int64)
    if states.shape != (first.size, program.slopes.size):
        raise InputError(
            f"start states of shape {states.shape} for {first.size} window(s) of {program.slopes.size} states",
            where="simulate",
        )
    if compiled.lags:
        states = states.copy()
    for lag in compiled.lags:
        straight, constant = compiled.model.inputs[lag.column].hold == "linear", float(parameters[lag.parameter])
        behind = lag_signal(drive.t, np.ascontiguousarray(drive.inputs[:, lag.column]), constant, straight)
        states[:, lag.state] = np.interp(drive.t[first] - late[lag.column], drive.t, behind)
    outputs = np.full((program.outputs.size, rows), np.nan)
    ends, status = np.full(states.shape, np.nan), np.zeros((first.size, 3))
    native = _TRANSLATOR.native(program.code, program.still, program.dynamic, int(np.sum(last - first)))
    tape = program.tape(0 if native is None else native.address)
    kernel.run(
        tape, program.registers, np.ascontiguousarray(parameters, dtype=np.float64), drive.t, drive.inputs,
        late if delays is None else np.asarray(delays, dtype=np.float64),
        first, last, states, tolerance, float(compiled.most_steps), float(compiled.spare_steps),
        outputs, ends, status,
    )  # fmt: skip
    reasons = status[:, 0].astype(np.int64)
    return Run(outputs=outputs.T, ends=ends, reasons=reasons, until_s=status[:, 1], steps=status[:, 2])


def _arriving(compiled: Compiled, parameters: FloatArray, drive: Drive) -> tuple[FloatArray, Drive, FloatArray]:
    """Return the equations' own parameters, the inputs that reach them, and the dead times of these."""
    delays = compiled.delays
    if not compiled.held:
        return parameters, drive, delays
    own = parameters.size - len(compiled.held)
    inputs = drive.inputs.copy()
    for one, value in zip(compiled.held, parameters[own:], strict=True):
        if one.transform is None:
            delays[one.column] += value
        else:
            inputs[:, one.column] = one.transform(drive.t, inputs[:, one.column], float(value))
    return parameters[:own], replace(drive, inputs=inputs), delays


def derivatives(
    compiled: Compiled, parameters: FloatArray, states: FloatArray, inputs: FloatArray, t_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Evaluate the equations at points.

    Parameters
    ----------
    compiled : Compiled
        The model.
    parameters : (P,) array
        Its parameters.
    states, inputs : (points, n), (points, m) arrays
        Where.
    t_s : float
        Time [s].

    Returns
    -------
    slopes, outputs : (points, n), (points, 1 + signals) arrays
        Derivatives, and y with the signals.
    """
    found: tuple[FloatArray, FloatArray] = kernel.look(
        compiled.program.tape(),
        compiled.program.registers,
        np.ascontiguousarray(parameters[: parameters.size - len(compiled.held)], dtype=np.float64),
        np.ascontiguousarray(np.atleast_2d(states), dtype=np.float64),
        np.ascontiguousarray(np.atleast_2d(inputs), dtype=np.float64),
        t_s,
    )
    return found


def require_complete(run: Run, compiled: Compiled, where: str) -> Run:
    """Return a run that reached its end.

    Parameters
    ----------
    run : Run
        The run, of one window or several.
    compiled : Compiled
        The model, for the message.
    where : str
        The recording, for the message.

    Raises
    ------
    InputError
        Says when the simulation ended, and why.
    """
    if run.is_complete:
        return run
    window = int(np.argmax(run.reasons != kernel.DONE))
    at = f"at t = {run.until_s[window]:g} s"
    if run.reasons[window] == kernel.NOT_A_NUMBER:
        what = f"the simulation of {compiled.model.name!r} runs away or a term is no number {at}"
        remedy = "check signs and units, and roots and logarithms of what may become negative: sqrt(max(h, 0))"
    else:
        most = f"{kernel.MOST_STEPS} steps between two rows, or {compiled.most_steps:g} on average,"
        what = f"the simulation of {compiled.model.name!r} needs more than {most} {at}"
        remedy = "check time constants that are far shorter than the rows' distance"
    raise InputError(what, where=where, remedy=remedy)
