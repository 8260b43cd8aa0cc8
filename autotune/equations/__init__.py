"""Models of equations: what a person wrote as differential equations, read, checked, simulated, retuned, exported.

The way of a file through the room::

    expressions.py   text -> tree; nothing is evaluated as Python
    model.py         EquationModel, and Extension: what is added to one, in the model's own language
    units.py         units checked where they are given
    read.py          TOML -> EquationModel and back
    tape.py          EquationModel + Extensions -> Program, a tape of elementary operations; a millisecond
    kernel.py        the one compiled integrator of all tapes: adaptive, switched terms located, friction sticks, stiff
    simulate.py      compile_model, drive_of, simulate: the interface below
    effects.py       catalogue names -> Extension, by the kind of state, by port, input or output; equation_of
    sensitivity.py   dy/dparameters and dy/dstart by differences along the same steps
    starts.py        rest, and start states that fit the readings
    fit.py           fit on given windows, retune from short windows to the free run; beliefs counted
    identifiability  which combinations of parameters the recordings do not determine
    forecast.py      what ``autotune simulate`` does, with and without --horizon
    files.py         read_any_model: a chain of blocks, or equations

The narrow interface that a diagnosis builds on::

    compiled = compile_model(model, extensions, signals)   # nothing to compile per model or effect
    drive = drive_of(model, recording)                        # t (N,) and inputs (N, m); transform samples here
    run = simulate(compiled, parameters, drive, start_states, starts=..., stops=..., delays=...)
    run.y, run.outputs, run.ends, run.is_complete             # (N,), (N, 1 + signals), (W, n), bool

``parameters`` is a vector in the order of ``compiled.parameters``: the model's own first, then those that extensions
bring, so that a fit treats them alike. ``start_states`` is (W, n) in the order of ``compiled.states``, states that
extensions bring last. ``signals`` are expressions wanted at the rows beside y: a speed, ``across`` of a port, a force.

An ``Extension`` is an effect in the model's own language:

======================  ==========================================================  =================================
place                   how                                                         example
======================  ==========================================================  =================================
derivative of a state   ``derivative={"omega": e}``: added                          ``-F/J*sign(omega)`` sticks at rest
port                    ``port={"F_d": e}``: added where the model leaves 0         ``-c*(vb - vw)``
input column            ``input={"u": e}``: replaced, the column is ``value``       ``min(max(value, low), high)``
output                  ``output=e``: replaced, the undisturbed one is ``value``    ``value + drift*t``
memory of its own       ``states=(State(...),)`` that may use ``value``             ``(value - lag)/T``
dead time               ``delays=`` of ``simulate``, per input [s]                  continuous: its derivative is smooth
samples                 on ``drive`` before, on ``run.y`` after                     quantiser, jitter, outliers
======================  ==========================================================  =================================

Switched terms (``sign abs min max if``) are located, and a state that both sides push back stays on the surface:
``-F*sign(v)`` is Coulomb friction with true sticking, ``R*sign(u - w)`` a rate limiter that holds once it has caught
up. Nothing needs to be smoothed.

Errors: local error of each step within 1e-6 of the largest magnitude a state has had (``tolerance``); crossings
within 1e-9 of the rows' distance; stiff models go on with an L-stable method. A window that runs away is NaN from
there on with a reason in ``run.reasons``; :func:`~autotune.equations.simulate.require_complete` turns it into one line.
"""

from autotune.equations.effects import apply
from autotune.equations.expressions import parse, to_text
from autotune.equations.fit import fit, retune
from autotune.equations.fit_data import Fitted
from autotune.equations.forecast import forecast
from autotune.equations.identifiability import combinations, undetermined
from autotune.equations.model import (
    EquationModel,
    Extension,
    InputColumn,
    ModelParameter,
    ModelPort,
    State,
)
from autotune.equations.read import read_equations, write_equations
from autotune.equations.simulate import (
    TOLERANCE,
    Compiled,
    Drive,
    Run,
    compile_model,
    derivatives,
    drive_of,
    require_complete,
    simulate,
)

__all__ = [
    "TOLERANCE",
    "Compiled",
    "Drive",
    "EquationModel",
    "Extension",
    "Fitted",
    "InputColumn",
    "ModelParameter",
    "ModelPort",
    "Run",
    "State",
    "apply",
    "combinations",
    "compile_model",
    "derivatives",
    "drive_of",
    "fit",
    "forecast",
    "parse",
    "read_equations",
    "require_complete",
    "retune",
    "simulate",
    "to_text",
    "undetermined",
    "write_equations",
]
