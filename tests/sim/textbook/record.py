"""Recordings of a textbook plant: integrated row by row by LSODA, with one effect concealed or none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import odeint

from tests.sim.textbook.hidden import Hidden, Scale, hidden
from tests.sim.textbook.plant import Floats, Numbers, Plant

#: Error of a step, relative and of a state's usual size.
RELATIVE, ABSOLUTE = 1e-10, 1e-11


@dataclass(frozen=True, kw_only=True, eq=False)
class Made:
    """A recording with what is known of it alone here.

    Attributes
    ----------
    t, y : (rows,) arrays
        Time stamps and readings.
    columns : dict of (rows,) arrays
        Inputs as they are recorded, the command first.
    states : (rows, n) array
        True states.
    """

    t: Floats
    y: Floats
    columns: dict[str, Floats]
    states: Floats

    def csv(self) -> str:
        """Return the file's text."""
        names = ["t", "u", "y", *list(self.columns)[1:]]
        table = np.column_stack([self.t, self.columns["u"], self.y, *list(self.columns.values())[1:]])
        return "\n".join([",".join(names), *(",".join(f"{v:.9g}" for v in row) for row in table)]) + "\n"


def truth(plant: Plant, rng: np.random.Generator, spread: float = 0.08) -> Numbers:
    """Return the true numbers: those that may be retuned lie about the nominal ones.

    Parameters
    ----------
    plant : Plant
        Has the nominal numbers.
    rng : numpy.random.Generator
        Source of the true ones.
    spread : float
        Standard deviation of their logarithms.
    """
    free = plant.retuned
    return {n: v * float(np.exp(spread * rng.normal())) if n in free else v for n, v in plant.nominal.items()}


def scale_of(plant: Plant, made: Made, where: str) -> Scale:
    """Return how a clean recording moves at a place.

    Parameters
    ----------
    plant : Plant
        Has the places.
    made : Made
        A clean recording with its states.
    where : str
        Name of the place.
    """
    place = next((one for one in plant.places if one.name == where), None)
    speed = np.array([place.speed(x) if place else 0.0 for x in made.states.tolist()])
    position = np.array([place.position(x) if place else 0.0 for x in made.states.tolist()])
    middle = float(np.median(position))
    return Scale(
        dt_s=plant.dt_s, duration_s=float(made.t[-1]), u=made.columns["u"], y=made.y, speed=float(np.std(speed)),
        position=float(np.std(position)), top=float(np.max(position)) - middle, middle=middle,
        force=float(np.std(np.diff(speed) / plant.dt_s)) * (place.inertia if place else 1.0), noise=plant.noise,
    )  # fmt: skip


def pair(plant: Plant, seed: int, effect: tuple[str, str, float] | None, is_outside: bool = False) -> list[Made]:
    """Return two recordings with the same truth, and an effect of the plant's list or none in them.

    Parameters
    ----------
    plant : Plant
        The plant.
    seed : int
        Of numbers, excitation, sizes and noise.
    effect : (name, place, size), optional
        What is concealed.
    is_outside : bool
        Whether what acts is in no catalogue.

    Raises
    ------
    ValueError
        The plant leaves its working range however small the effect.
    """
    low, high = plant.within
    for smaller in (1.0, 0.6, 0.35, 0.2):
        less = None if effect is None else (*effect[:2], smaller * effect[2])
        made = _pair(plant, seed, less, is_outside)
        if all(low < one.y.min() and one.y.max() < high for one in made):
            return made
    raise ValueError(f"{plant.name} does not stay between {low} and {high}")


def _pair(plant: Plant, seed: int, effect: tuple[str, str, float] | None, is_outside: bool) -> list[Made]:
    rng = np.random.default_rng(seed)
    numbers = truth(plant, rng)
    used = replace(plant, slopes=plant.outside) if is_outside else plant
    columns = [plant.columns(rng, plant.rows) for _ in range(2)]
    concealed = Hidden()
    if effect is not None:
        clean = record(plant, numbers, columns[0], np.random.default_rng(seed))
        place = next((one for one in plant.places if one.name == effect[1]), None)
        concealed = hidden(*effect, place, scale_of(plant, clean, effect[1]), rng)
    return [record(used, numbers, one, rng, concealed) for one in columns]


def record(
    plant: Plant,
    numbers: Numbers,
    columns: dict[str, Floats],
    rng: np.random.Generator,
    effect: Hidden = Hidden(),  # noqa: B008 - frozen, without effect
) -> Made:
    """Integrate a plant over its inputs, a command held from its row on."""
    rows, dt = plant.rows, plant.dt_s
    names = list(columns)
    linear = np.column_stack([columns[name] for name in names[1:]]) if len(names) > 1 else np.zeros((rows, 0))
    x = np.array([*plant.start, columns["u"][0]])
    place = next((i for i, one in enumerate(plant.places) if one.name == effect.where), 0)
    u, arriving, y, states = np.zeros(rows), np.zeros(rows), np.zeros(rows), np.zeros((rows, len(plant.start)))
    noise, memory = rng.normal(0.0, plant.noise, rows), dict[str, float]()
    late, rest = divmod(effect.delay_s / dt, 1.0)
    for k in range(rows):
        t, now, nxt = k * dt, linear[k], linear[min(k + 1, rows - 1)]
        states[k] = x[:-1]
        clean = plant.reading(x[:-1].tolist(), (float(arriving[k - 1] if k else columns["u"][0]), *now.tolist()))
        y[k] = effect.converted(effect.reading(t, clean) + noise[k])
        u[k] = columns["u"][k] + (plant.law(k, float(y[k]), memory) if plant.law else 0.0)
        arriving[k] = effect.held(float(u[k]), float(arriving[k - 1] if k else u[k]))
        before, after = arriving[max(k - int(late) - 1, 0)], arriving[max(k - int(late), 0)]
        if rest > 0.0:
            x = _advanced(plant, numbers, effect, place, x, t, rest * dt, before, (now, nxt, t))
        x = _advanced(plant, numbers, effect, place, x, t + rest * dt, (1.0 - rest) * dt, after, (now, nxt, t))
    return Made(
        t=np.arange(rows, dtype=np.float64) * dt, y=effect.spoiled(y), columns={**columns, "u": u}, states=states
    )


def _advanced(
    plant: Plant, numbers: Numbers, effect: Hidden, place: int, x: Floats, t0: float, length: float, u: float,
    measured: tuple[Floats, Floats, float],
) -> Floats:  # fmt: skip
    """Return the states, the actuator's own last, after a stretch of a held command and straight measured inputs."""
    now, nxt, begin = measured
    rate = [float(v) for v in (nxt - now) / plant.dt_s]
    first = [float(v) for v in now]
    at, force, actuator, count = plant.places, effect.force, effect.actuator, len(plant.places)
    level, dt = float(u), plant.dt_s

    def slopes(t: float, z: Floats) -> list[float]:
        x: list[float] = z.tolist()
        own = x.pop()
        acting = [0.0] * count
        if force is not None:
            acting[place] = force(t, at[place].speed(x), at[place].position(x))
        w = (effect.command(t, level, own), *(a + b * (t - begin) for a, b in zip(first, rate, strict=True)))
        return [*plant.slopes(t, x, w, acting, numbers), 0.0 if actuator is None else actuator(level, own)]

    size = ABSOLUTE * np.maximum(np.abs(x), 1e-3)
    found = odeint(  # type: ignore[call-overload]  # the stubs know no list of slopes
        slopes, x, [t0, t0 + length], tfirst=True, rtol=RELATIVE, atol=size, hmax=dt, mxstep=20000
    )
    return np.asarray(found[-1], dtype=np.float64)
