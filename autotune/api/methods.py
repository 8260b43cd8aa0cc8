"""Reduce, design, margins, validation, delays, closed loops, transitions: from what a person has, in one call each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.api.plants import as_controller, as_loop_plant, as_plant, as_reduced
from autotune.api.points import as_points
from autotune.api.recordings import Source, as_recordings, read
from autotune.arguments import number, one_of, settings_of
from autotune.arrays import is_real
from autotune.controller import Controller, PIDController
from autotune.errors import InputError

if TYPE_CHECKING:
    from autotune.design.margins import Margins
    from autotune.design.nugap import Validation
    from autotune.design.reference import Trajectory
    from autotune.design.specification import Design, Specification
    from autotune.identification.closed_loop.identify import ClosedLoopIdentification
    from autotune.identification.closed_loop.state_space import InnovationModel
    from autotune.identification.delay.model import DelayModel
    from autotune.identification.delay.two_delays import TwoDelays
    from autotune.identification.reduction import ReducedModel
    from autotune.models import TransferFunction
    from autotune.recording import Recording

KINDS = ("pi", "pid")
DELAY_METHODS = ("output-error", "algebraic", "online")


def reduce(source: Any, **settings: Any) -> ReducedModel:
    """Return the cautious low-order model (8) or (24) of points or of a known plant.

    Parameters
    ----------
    source : points, TransferFunction, model or its file, python-control system
        Points are reduced on their regions.
    **settings
        Of :func:`autotune.identification.reduction.reduce_points`: ``kind``, ``conditions``, ``static_gain``.

    Returns
    -------
    ReducedModel
        Its ``transfer_function()`` is the model; ``warnings`` say what it does not promise.

    Examples
    --------
    >>> import autotune as at
    >>> model = at.reduce(at.example("ball"))
    >>> round(model.G_r, 1), model.integrating
    (-65.5, True)
    """
    from autotune.identification.reduction import reduce_points, reduce_transfer_function
    from autotune.points import require_regions

    points = as_points(source)
    if points is None:
        if settings:
            settings_of(reduce_transfer_function, settings, where="reduce, of a known plant")
        return reduce_transfer_function(as_plant(source))
    require_regions(points, "reduce")
    return reduce_points(points, **settings_of(reduce_points, settings, where="reduce"))


def tune(
    plant: Any,
    *,
    modulus_margin: float = 0.5,
    phase_margin_deg: float = 45.0,
    noise_gain: float | None = None,
    kind: str = "pi",
    certificate: bool = True,
    **settings: Any,
) -> Design:
    """Return the PI or PID that rejects load steps best and keeps the margins.

    Parameters
    ----------
    plant : recording, its file, points, TransferFunction, model, reduced or delay model, python-control system
        A recording, a list of them, a DataFrame or the file of one is tuned as ``autotune tune FILE`` does. On points
        the margins hold for every plant that fits them; on a loop's identification on the joint region of its
        coefficients; on a reduced model, a PI's are kept on what was reduced as well.
    modulus_margin : float
        Smallest distance of the Nyquist curve from -1, 0 to 1.
    phase_margin_deg : float
        Smallest phase margin [deg].
    noise_gain : float, optional
        Largest amplification of measurement noise to the command, N_max [u unit/y unit]. When absent, of a recording
        from its noise and the span of u, else ten over the plant's gain where its phase is -135 degrees.
    kind : {"pi", "pid"}
        Structure.
    certificate : bool
        Whether a lower bound of the norm is proven (PI on a model).
    **settings
        Further ones of :class:`autotune.design.specification.Specification`, such as ``delay_margin_s``; of a
        recording ``criterion``, ``source``, ``noise_frequency_rad_s`` and ``sample_time_s``, the controller's period.

    Returns
    -------
    Design
        ``controller``, ``margins``, ``h2`` and what binds.

    Raises
    ------
    DesignError
        No such controller; names the nearest margins that can be had.

    Examples
    --------
    >>> import autotune as at
    >>> design = at.tune(at.example("ball"), noise_gain=0.1)
    >>> design.margins.modulus >= 0.499
    True
    """
    structure = one_of(kind, KINDS, name="kind", where="tune")
    if not isinstance(certificate, bool):
        raise InputError(f"certificate = {certificate!r}"[:200], where="tune", remedy="True or False")
    records = as_recordings(plant)
    if records is not None:
        margins_asked = {"modulus_margin": modulus_margin, "phase_margin_deg": phase_margin_deg}
        return _of_recordings(records, {"kind": structure, "noise_gain": noise_gain, **margins_asked, **settings})

    def wanted(of: TransferFunction, highest_rad_s: float | None = None) -> Specification:
        from autotune.design.noise import LoopFacts, default_noise_gain

        most = default_noise_gain(of, LoopFacts(), highest_rad_s)[0] if noise_gain is None else noise_gain
        return _specification(modulus_margin, phase_margin_deg, most, settings)

    of_loop = as_loop_plant(plant)
    if of_loop is not None:
        from autotune.design.on_fit import design_on_fit

        return design_on_fit(of_loop, wanted(of_loop.plant), structure)
    points = as_points(plant)
    if points is not None:
        from autotune.identification.parametric import fit_plant
        from autotune.pipeline.analysis import of_use, on_measured
        from autotune.points import require_regions

        require_regions(points, "tune")
        measured = of_use(points)
        fit = fit_plant(measured)
        return on_measured(measured, fit, wanted(fit.plant, measured[-1].omega_rad_s), structure)[1]
    reduced = as_reduced(plant)
    if reduced is not None:
        from autotune.pipeline.analysis import on_reduced_model

        of = wanted(reduced.transfer_function())
        return on_reduced_model(reduced, of, structure, certificate=certificate)[0]
    from autotune.design.synthesis import design as on_model

    H = as_plant(plant)
    return on_model(H, wanted(H), structure, certificate=certificate)


def _of_recordings(records: list[Recording], settings: dict[str, Any]) -> Design:
    from autotune.config.procedure import DesignSettings
    from autotune.pipeline import analyse, measure_plant
    from autotune.schema import validate

    asked = validate(DesignSettings, settings, "tune, of a recording")
    measured = measure_plant(records)
    return analyse(measured.points, asked, fit=measured.fit, facts=measured.facts, compare=False).design


def _specification(
    modulus_margin: float, phase_margin_deg: float, noise_gain: float, settings: dict[str, Any]
) -> Specification:
    from autotune.design.specification import Specification

    asked = settings_of(Specification, settings, where="tune")
    return Specification(
        modulus_margin=number(modulus_margin, name="modulus_margin", where="tune"),
        phase_margin_rad=math.radians(number(phase_margin_deg, name="phase_margin_deg", where="tune")),
        noise_gain=number(noise_gain, name="noise_gain", where="tune"),
        **asked,
    )


def margins(plant: Any, controller: Any) -> Margins:
    """Return stability, modulus, phase, delay and gain margin, noise gain and H2 norm of a loop.

    Parameters
    ----------
    plant : TransferFunction, model or its file, reduced or delay model, python-control system
        The plant.
    controller : PI, design, controller file, python-control system
        The controller; a sampled one is taken with its hold.

    Examples
    --------
    >>> import autotune as at
    >>> margins = at.margins(at.example("ball"), at.PI(K=-0.023, Ti_s=3.0))
    >>> round(margins.modulus, 4), margins.stable
    (0.6818, True)
    """
    from autotune.design.margins import margins as of_loop

    H, C = as_plant(plant), as_controller(controller)
    if (isinstance(C, PIDController) and C.K == 0.0) or not any(H.num):
        raise InputError("there is no loop: a gain is 0", where="margins", remedy="give a plant and a controller")
    with np.errstate(all="ignore"):
        result = of_loop(H, C)
    if math.isnan(result.modulus + result.phase_rad):
        raise InputError("the loop's response leaves the range of numbers", where="margins", remedy="check its units")
    return result


def validate(plant: Any, model: Any, controller: Any = None, *, scaling: float | None = None) -> Validation:
    """Return criterion (10): the nu-gap of a plant and a model of it, beside the stability margins b with a controller.

    Parameters
    ----------
    plant, model : TransferFunction, model or its file, reduced model, python-control system
        H and H_r.
    controller : PI, design, controller file, optional
        C; designed on ``model`` when absent.
    scaling : float, optional
        k: plants are taken as k H, the controller as C/k, on which the nu-gap depends. The loop's own, the controller's
        gain at crossover, when absent; 1 is the criterion as the paper prints it.

    Examples
    --------
    >>> import autotune as at
    >>> ball = at.example("ball")
    >>> criterion = at.validate(ball, at.reduce(ball), at.PI(K=-0.023, Ti_s=3.0))
    >>> criterion.holds
    True
    """
    from autotune.design.nugap import loop_scaling
    from autotune.design.nugap import validate as compare

    reduced = as_plant(model)
    law: Controller = tune(reduced).controller if controller is None else as_controller(controller)
    if scaling is not None:
        scaling = number(scaling, name="scaling", where="validate", above=0.0)
    k = loop_scaling(reduced, law) if scaling is None else scaling
    return compare(as_plant(plant), reduced, law, scaling=k)


def transition(
    plant: Any,
    *,
    y_start: float,
    y_end: float,
    u_rest: float,
    u_min: float,
    u_max: float,
    u_rate: float = math.inf,
    y_speed: float = math.inf,
) -> Trajectory:
    """Return the fastest smooth transition between two rests within limits, and the command that follows it.

    Parameters
    ----------
    plant : delay model, TransferFunction without zeros, model or its file
        What the command is computed with.
    y_start, y_end : float
        Outputs at rest.
    u_rest : float
        Command that holds ``y_start``.
    u_min, u_max, u_rate, y_speed : float
        Limits of the command, of its change per second, and of the output's speed.

    Examples
    --------
    >>> import autotune as at
    >>> plant = at.TransferFunction(num=(2.0,), den=(6.0, 5.0, 1.0), delay_s=0.5)
    >>> move = at.transition(plant, y_start=0.0, y_end=1.0, u_rest=0.0, u_min=-2.0, u_max=2.0)
    >>> move.binding
    'command'
    """
    from autotune.design.reference import flat_transition

    levels = {"y_start": y_start, "y_end": y_end, "u_rest": u_rest}
    limits = {"u_min": u_min, "u_max": u_max, "u_rate": u_rate, "y_speed": y_speed}
    for name, value in limits.items():
        if not is_real(value) or math.isnan(value):
            raise InputError(f"{name} = {value!r}"[:200], where="transition", remedy="a number; infinite for no limit")
    exact = {name: number(value, name=name, where="transition") for name, value in levels.items()}
    return flat_transition(as_plant(plant), **exact, **{name: float(value) for name, value in limits.items()})


def delay(
    recording: Source,
    order: int = 2,
    *,
    method: str = "output-error",
    delays: int = 1,
    interval_s: float | None = None,
    **settings: Any,
) -> DelayModel | TwoDelays:
    """Return the model x^(n) = sum a_i x^(i) + b u(t - h) of a recording, with its covariance.

    Parameters
    ----------
    recording : Recording, path, DataFrame, mapping of arrays
        u and y, in open or closed loop.
    order : int
        Order n.
    method : {"output-error", "algebraic", "online"}
        Maximum likelihood, which needs no starting value; or the modulating functions, on intervals or row by row.
    delays : {1, 2}
        2 is x'' + a x(t - h_1) = b u(t - h_2).
    interval_s : float, optional
        Length of the modulated intervals [s].
    **settings
        Of :func:`autotune.identification.delay.identify.identify_delay`, such as ``max_delay_s`` or ``integrator``.

    Examples
    --------
    >>> import autotune as at
    >>> model = at.delay(at.example("oven"))
    >>> abs(model.delay_s - 0.5) < 0.05
    True
    """
    from autotune.identification.answer import require_answer

    way = one_of(method, DELAY_METHODS, name="method", where="delay")
    order = int(number(order, name="order", where="delay", above=0, whole=True))
    if interval_s is not None:
        interval_s = number(interval_s, name="interval_s", where="delay", above=0.0)
    if not isinstance(delays, int) or isinstance(delays, bool) or delays not in (1, 2):
        raise InputError(f"delays = {delays!r}", where="delay", remedy="1, or 2 for x'' + a x(t - h_1) = b u(t - h_2)")
    record = read(recording)
    fit = _fit_two_delays(interval_s, settings) if delays == 2 else _fit_delay(way, order, interval_s, settings)
    require_answer([record])  # after the settings, which are refused first
    return fit(record)


def _fit_two_delays(interval_s: float | None, settings: dict[str, Any]) -> Callable[[Recording], TwoDelays]:
    """Return the fit of two dead times, its settings checked."""
    from autotune.identification.delay.two_delays import intervals_of, two_delays

    asked = settings_of(two_delays, settings, where="delay, delays = 2")
    return lambda record: two_delays(record, intervals_of(record, interval_s), **asked)


def _fit_delay(
    way: str, order: int, interval_s: float | None, settings: dict[str, Any]
) -> Callable[[Recording], DelayModel]:
    """Return the fit of one dead time by a method, its settings checked."""
    if way == "output-error":
        from autotune.identification.delay.identify import identify_delay

        if interval_s is not None:
            raise InputError("interval_s is of the modulating functions", where="delay", remedy='method="algebraic"')
        asked = settings_of(identify_delay, settings, where="delay")
        return lambda record: identify_delay(record, order, **asked)
    from autotune.identification.delay.methods import algebraic_delay, online_delay

    if way == "algebraic":
        asked = settings_of(algebraic_delay, {"interval_s": interval_s, **settings}, where="delay, algebraic")
        return lambda record: algebraic_delay(record, order, **asked)
    asked = settings_of(online_delay, settings, where="delay, online")

    def fit_online(record: Recording) -> DelayModel:
        if "start_s" in asked:
            return online_delay(record, order, **asked)
        start_s = algebraic_delay(record, order, interval_s=interval_s).delay_s
        return online_delay(record, order, start_s=start_s, **asked)

    return fit_online


def closed_loop(
    recording: Source,
    order: int | None = None,
    *,
    controller: Any = None,
    method: str = "prediction-error",
    more: tuple[Sequence[str], Sequence[str], Sequence[str]] = ((), (), ()),
    **settings: Any,
) -> ClosedLoopIdentification | InnovationModel:
    """Return the plant's model from a recording of its loop.

    Parameters
    ----------
    recording : Recording, path, DataFrame, mapping of arrays
        u, y, and r where it is known.
    order : int, optional
        Number of states; chosen from the data when absent.
    controller : PI, design, controller file, optional
        Checked against the data.
    method : str
        "prediction-error", with regions, evidence and a verdict on the excitation; or one of
        :data:`autotune.identification.closed_loop.methods.METHODS`, which give a model alone.
    more : three sequences of str
        Columns of further inputs, outputs and excitations.
    **settings
        Of :func:`autotune.identification.closed_loop.identify.identify_closed_loop`, such as ``max_order``; of the
        other methods ``f``, ``p``, ``n_cl`` and ``Psi``, see
        :class:`autotune.identification.closed_loop.methods.Windows`.

    Examples
    --------
    >>> import autotune as at
    >>> loop = at.closed_loop(at.example("loop"), order=5)
    >>> len(loop.poles)
    5
    """
    from autotune.identification.answer import require_answer
    from autotune.identification.closed_loop.identify import identify_closed_loop
    from autotune.identification.closed_loop.methods import METHODS, Windows
    from autotune.identification.closed_loop.signals import model_of_recording

    way = one_of(method, METHODS, name="method", where="closed_loop")
    if order is not None:
        order = int(number(order, name="order", where="closed_loop", above=0, whole=True))
    if not isinstance(more, tuple | list) or len(more) != 3 or not all(map(_are_names, more)):
        raise InputError(
            f"more = {more!r}"[:200], where="closed_loop", remedy="three lists of columns: inputs, outputs, r"
        )
    record = read(recording)
    law = None if controller is None else as_controller(controller)
    fit: Callable[[], ClosedLoopIdentification | InnovationModel]
    if way == "prediction-error" and not any(more):
        asked = settings_of(identify_closed_loop, settings, where="closed_loop")
        fit = partial(identify_closed_loop, record, order=order, controller=law, **asked)
    else:
        windows = Windows(**settings_of(Windows, settings, where=f"closed_loop, {way}"))
        fit = partial(
            model_of_recording, record, method=way, order=order, controller=law, more=more, windows=windows
        )  # fmt: skip
    require_answer([record])  # after the settings, which are refused first
    return fit()


def _are_names(value: Any) -> bool:
    return isinstance(value, tuple | list) and all(isinstance(name, str) for name in value)
