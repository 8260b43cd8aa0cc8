"""Free-run simulation of a model with its effects: the chain assembled once, then driven by recordings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache

import numpy as np
from scipy.linalg import expm

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis.simulation import kernel
from autotune.diagnosis.simulation.chain import Chain
from autotune.diagnosis.simulation.compiled import Layout, Run, compiled_run, layout_of
from autotune.diagnosis.simulation.transitions import transition_table
from autotune.effects import ALL
from autotune.effects.base import EffectKind
from autotune.effects.stages import STAGES, StageName
from autotune.recording import Recording

#: Sub-steps of a sample at most, of one whose command runs straight between rows, and the largest sub-step of a forced
#: plant in units of its fastest time constant.
MOST_PIECES, _LINEAR, FASTEST = 8, 4, 0.2
#: 0 degrees Celsius [K].
ICE_K = 273.15


@dataclass(frozen=True, kw_only=True, eq=False)
class Windows:
    """Where a simulation starts anew and ends: rows, (W,) each, the last row excluded.

    ``places`` are the rows of the output where windows begin, and ``rows`` how many it has; by default it has a row for
    each of the recording's.
    """

    starts: IntArray
    stops: IntArray
    places: IntArray | None = None
    rows: int | None = None

    @cached_property
    def table(self) -> IntArray:
        """First rows, rows after the last, and where each window begins in the output, (3, W)."""
        places = self.starts if self.places is None else self.places
        return np.stack((self.starts, self.stops, places)).astype(np.int64)

    @cached_property
    def last_row(self) -> int:
        """The row before which the last window ends, 0 without one."""
        return int(self.stops.max(initial=0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulator:
    """An assembled model, ready to be driven.

    Attributes
    ----------
    chain : Chain
        Linear chain, blocks that effects add included.
    falling : Chain
        The chain while the actuator falls; the same object where its lag does not depend on the direction.
    kinds : tuple of EffectKind
        Effects that act beside the chain.
    values, acts : array
        Their parameters and flags, as the compiled simulation has them.
    u_offset, y_offset : float
        Operating point.
    kelvin : float
        Absolute temperature at the operating point, were y one.
    linear_hold : bool
        Whether u runs straight between rows.
    compiled : callable
        The compiled simulation that ``values`` and ``acts`` are laid out for.
    """

    chain: Chain
    falling: Chain
    kinds: tuple[EffectKind, ...]
    values: FloatArray
    acts: IntArray
    u_offset: float
    y_offset: float
    kelvin: float
    linear_hold: bool
    compiled: Run = field(default_factory=compiled_run, repr=False)

    @property
    def order(self) -> int:
        """Number of states."""
        return self.chain.order

    @property
    def is_linear(self) -> bool:
        """Whether it is the chain alone."""
        return not any(kind.lines for kind in self.kinds) and self.falling is self.chain

    def linear(self) -> Simulator:
        """Return the chain alone."""
        return replace(self, kinds=(), acts=np.zeros_like(self.acts), falling=self.chain)

    def driven_at(self, column: int) -> Simulator:
        """Return the chain alone, in deviations, driven where a column of its ``B`` enters: 0 is the command's."""
        plain = replace(self.linear(), u_offset=0.0, y_offset=0.0, linear_hold=False)
        if column == 0:
            return plain
        B = np.zeros_like(self.chain.B)
        B[:, 0] = self.chain.B[:, column]
        chain = replace(self.chain, B=B, gains=np.array([*self.chain.gains[:2], 0.0, 0.0]), delay_s=0.0)
        return replace(plain, chain=chain, falling=chain)

    def without_steps(self) -> Simulator:
        """Return the simulator without what makes steps of the readings."""
        kept = tuple(kind for kind in self.kinds if not kind.steps)
        acts = self.acts.copy()
        for kind in set(self.kinds) - set(kept):
            acts[layout().flag(kind.name)] = 0
        return replace(self, kinds=kept, acts=acts)

    def stepped(self, y: FloatArray) -> FloatArray:
        """Return what effects that make steps of readings make of them."""
        for kind in (kind for kind in self.kinds if kind.steps):
            values = {q.name: float(self.values[layout().slots[kind.name, q.name]]) for q in kind.parameters}
            y = np.array([kind.lines[0].does(one, **values) for one in y])
        return y

    def step_s(self, dt_s: float) -> float:
        """Return the longest sub-step [s] for a sample time: shorter where forces change within a sample."""
        pieces, is_forced = self.pieces
        if is_forced:
            pieces = max(pieces, math.ceil(self.chain.fastest_of_plant * dt_s / FASTEST))
        return dt_s / min(pieces, MOST_PIECES)

    @property
    def pieces(self) -> tuple[int, bool]:
        """Sub-steps of a sample at least, whatever its length, and whether forces ask for more."""
        return _pieces(self.kinds, self.linear_hold)

    def run(
        self,
        recording: Recording,
        x0: FloatArray,
        windows: Windows | None = None,
        *,
        number: int = 0,
        sample_time_s: float | None = None,
        signals: int = kernel.SIGNALS,
    ) -> tuple[FloatArray, FloatArray]:
        """Simulate a recording's rows.

        Parameters
        ----------
        recording : Recording
            Its t and u drive the chain.
        x0 : (W, n) or (n,) array
            State at each window's first row.
        windows : Windows, optional
            The whole recording by default.
        number : int
            The recording's number among those diagnosed.
        sample_time_s : float, optional
            The recording's, where it is known already.
        signals : int
            How many signals are asked for: all, or 1 for the reading alone.

        Returns
        -------
        signals : (N, signals) array
            Reading, speed, position (or level) and plant input at each row of the output; NaN outside the windows.
        ends : (W, n) array
            The state that every window ends with.
        """
        step = self.step_s(recording.sample_time_s if sample_time_s is None else sample_time_s)
        chain, (rows, count) = self.chain, _rows(windows, len(recording))
        states = np.empty((2, rows.shape[1], chain.order))
        states[0] = x0
        numbers, flags = self.numbers.copy(), self.flags
        numbers[kernel.STEP] = step
        flags[kernel.NUMBER], flags[kernel.SIGNALS_ASKED], flags[kernel.ROWS] = number, signals, count
        out = self.compiled(
            _driven(recording), rows, states, _tables(chain, self.falling, step), chain.taps, numbers, flags
        )
        return out.T, states[1]

    @cached_property
    def numbers(self) -> FloatArray:
        """What the compiled simulation is told in numbers; the step is filled in by each run."""
        place = (0.0, self.chain.delay_s, self.u_offset, self.y_offset, self.kelvin, float(self.chain.is_static))
        return np.concatenate([place, self.chain.gains, self.values])

    @property
    def flags(self) -> IntArray:
        """What it may leave out, see the positions in its body; each run fills in number, signals and rows."""
        where: tuple[int, ...] = tuple(self.chain.where.tolist())
        told = _told(self.kinds, self.linear_hold, self.falling is not self.chain, self.order, where)
        return np.concatenate([told, self.acts])

    def rest_state(self, u: float, y: float, sample_time_s: float) -> FloatArray:
        """Return the state nearest to rest under a command that gives a reading.

        Parameters
        ----------
        u, y : float
            Command and reading, absolute.
        sample_time_s : float
            Rates beyond one over it count as that: a lag of a nanosecond moves no other state.

        Returns
        -------
        (n,) array
            For an integrating chain at rest but for its reading; else the linear equilibrium, shifted to the reading.
        """
        return np.asarray(self.rest_states(np.array([u]), np.array([y]), sample_time_s)[0])

    def rest_states(self, u: FloatArray, y: FloatArray, sample_time_s: float) -> FloatArray:
        """Return the states, (W, n), nearest to rest under commands, (W,), that give readings, (W,).

        See :meth:`rest_state` for the sample time.
        """
        # least squares of: A x = -B w, and weighted: output = aim
        wrong = np.vstack([np.outer(-self.chain.B[:, 0], u - self.u_offset), y - self.y_offset])
        lhs = np.vstack([self.chain.A, self.chain.taps[kernel.OUTPUT]])
        sizes = self._answer(1.0 / sample_time_s)
        return np.ascontiguousarray(self._balanced(lhs, wrong, sizes, weight=1e3)[: self.order].T)

    def rest_at(self, y: float) -> tuple[FloatArray, float]:
        """Return the state, (n,), and the command from the operating point [u unit] of rest at a reading [y unit].

        Parameters
        ----------
        y : float
            Reading, absolute.
        """
        chain = self.chain
        lhs = np.block([[chain.A, chain.B[:, :1]], [chain.taps[kernel.OUTPUT], chain.gains[3:4]]])
        aim = np.append(np.zeros(self.order), y - self.y_offset)[:, None]
        rest = self._balanced(lhs, aim, self._answer())[:, 0]
        return rest[: self.order], float(rest[self.order])

    def _balanced(self, lhs: FloatArray, rhs: FloatArray, sizes: FloatArray, weight: float = 1.0) -> FloatArray:
        """Return a least-squares solution, states in their own sizes and rows in theirs, the last one weighted.

        The units of the signals would decide else what gives way where not all can be.
        """
        sizes = np.append(np.where(sizes > 0.0, sizes, 1.0), 1.0)[: lhs.shape[1]]
        scale = np.abs(lhs * sizes).max(axis=1, keepdims=True)
        scale[scale == 0.0] = 1.0
        scale[-1] /= weight
        return np.asarray(sizes[:, None] * np.linalg.lstsq(lhs * sizes / scale, rhs / scale, rcond=1e-12)[0])

    def state_sizes(self, span: float, spread: float, sample_time_s: float) -> FloatArray:
        """Return a size for every state: what the command's span makes of it, bounded by what the readings show.

        Parameters
        ----------
        span, spread : float
            Of all recordings, see :func:`autotune.diagnosis.simulation.assembly.spans_of`. Where no command moves, a
            state has the size that moves the reading by its spread, by free motion from there.
        sample_time_s : float
            Of all recordings the shortest; rates beyond one over it count as that, as of :meth:`rest_state`.
        """
        tap, resolved = self.chain.taps[kernel.OUTPUT], 1.0 / sample_time_s
        if span == 0.0 < spread:
            times = np.concatenate([[0.0], np.geomspace(0.05, 5.0, 8) / min(self._fastest, resolved)])
            moved = np.max([np.abs(tap @ expm(self.chain.A * t)) for t in times], axis=0)
            return np.asarray(spread / np.maximum(moved, 1e-12 * max(float(moved.max()), 1e-300)))
        states, read = self._answer(resolved) * span, tap != 0.0
        if spread > 0.0:
            states[read] = np.minimum(states[read], spread / np.abs(tap[read]))
        return np.where(states == 0.0, 1.0, states)

    def _answer(self, resolved: float = math.inf) -> FloatArray:
        """Return what commands of one make of the states, (n,): ones that stay, ones that grow as fast as states move.

        |(s I - A)^-1 B| at s a thousandth of the fastest rate that is resolved [1/s] (an integrator answers ever more)
        and past every rate: a speed is as large as its position's rate, and not as small as what a constant command
        leaves of it.
        """
        A, b = self.chain.A, self.chain.B[:, 0]
        rates = np.abs(np.linalg.eigvals(A))
        least = SLOWEST * min(self._fastest, resolved)
        grows = np.append(GROWTH * rates[rates > least], least)
        found = [np.abs(np.linalg.solve(s * np.eye(self.order) - A, b)) for s in grows]
        return np.asarray(np.max(found, axis=0))

    @cached_property
    def _fastest(self) -> float:
        """The fastest rate of the chain [1/s]; 1 of integrators alone, which have none."""
        return float(np.abs(np.linalg.eigvals(self.chain.A)).max(initial=0.0)) or 1.0


#: Rates at which a command grows that states are sized by: the least, of the fastest one, and factor on every rate.
SLOWEST, GROWTH = 1e-3, 1.3
_FORCED: tuple[StageName, ...] = tuple(name for name, stage in STAGES.items() if stage.is_force)
#: Stages that the body asks for one by one.
_TOLD: tuple[StageName, ...] = ("force", "friction", "outflow", "stop")
#: What memories begin with that the body sees to: commands before a window, rows between windows.
_STARTS = ("replay", "travel")


def _acts_at(kind: EffectKind, *names: StageName) -> bool:
    return not kind.stages.isdisjoint(names)


@lru_cache(maxsize=256)
def _pieces(kinds: tuple[EffectKind, ...], linear_hold: bool) -> tuple[int, bool]:
    least = max(_LINEAR if linear_hold else 1, *(kind.sub_steps for kind in kinds), 1)
    return least, any(_acts_at(kind, *_FORCED) for kind in kinds)


@lru_cache(maxsize=256)
def _told(
    kinds: tuple[EffectKind, ...], linear_hold: bool, directional: bool, order: int, where: tuple[int, ...]
) -> IntArray:
    """Return the flags of a chain of an order with effects; ``where`` are its states that the body asks for."""
    forced = any(_acts_at(kind, *_FORCED) for kind in kinds)
    driven = any(_acts_at(kind, "converter", "command", "stop") for kind in kinds)
    others = tuple(name for name in _FORCED if name != "friction")
    rubbed = forced and order == 2 and not any(_acts_at(kind, *others) for kind in kinds)
    told = (
        0, 0, int(linear_hold), int(directional), *where, int(forced),
        *(int(any(_acts_at(kind, stage) for kind in kinds)) for stage in _TOLD),
        int(any(_acts_at(kind, "sensor", "reading") for kind in kinds)),
        int(not (forced or driven or directional or linear_hold)),
        int(rubbed and not (driven or directional or linear_hold)),
        *(int(any(kind.memory is not None and kind.memory.start == start for kind in kinds)) for start in _STARTS), 0,
    )  # fmt: skip
    return np.array(told, dtype=np.int64)


@cache
def layout() -> Layout:
    """Return the layout of the compiled simulation with all effects of the catalogue."""
    return layout_of(ALL)


@lru_cache(maxsize=16)
def _driven(recording: Recording) -> FloatArray:
    return np.stack((recording.t, recording.u))


@lru_cache(maxsize=64)
def _tables(chain: Chain, falling: Chain, step_s: float) -> FloatArray:
    """Return chains' transitions for a step: the same for all recordings, and for all effects that add no block."""
    rising = transition_table(chain.A, chain.B, step_s)
    return np.stack((rising, rising if falling is chain else transition_table(falling.A, falling.B, step_s)))


def _rows(windows: Windows | None, count: int) -> tuple[IntArray, int]:
    """Return what the compiled simulation is told of windows, and how many rows it returns.

    Raises
    ------
    ValueError
        A window ends beyond the recording's rows: compiled code would read whatever memory lies there.
    """
    if windows is None:
        return np.array([[0], [count], [0]], dtype=np.int64), count
    if windows.last_row > count:
        raise ValueError(f"a window ends at row {windows.last_row} of {count}")
    return windows.table, count if windows.rows is None else windows.rows
