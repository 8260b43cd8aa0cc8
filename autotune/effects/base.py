"""What is known of one effect, in one record: equation, parameters, compiled lines, linear part, searches, source.

An effect acts in one or both of two ways. A *line* is a small plain function of scalars that is put into the compiled
simulation at a stage (:data:`autotune.effects.stages.STAGES`); its arguments are taken by their names:
signals of the stage, the effect's own parameters, its memory. A *linear part* changes the blocks of the chain. What is
incomplete is refused when the package is imported, see :mod:`autotune.effects.checks`.

Most of the file says what each attribute means.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Literal, Protocol, TypeAlias

from autotune.arrays import FloatArray
from autotune.effects.in_equations import InEquations
from autotune.effects.stages import Line, LinearPart, Memory, StageName, Values
from autotune.models import Model, Parameter

#: What a parameter is to a search.
#: ``amplitude``: the effect is about proportional to it, so that a first-order look tells its size.
#: ``limit``: acts where a signal reaches it; where none did it goes back to its neutral value.
#: ``threshold``, ``time``, ``shape``: found by fits from several starts.
#: ``location``: no derivative tells it; a direct search sets it, and it counts as a free number.
#: ``mark``: says where the effect acts (a recording's number); set by a direct search, counts nothing, is not shown.
#: ``observed``: read off the samples, never simulated.
Role: TypeAlias = Literal["amplitude", "limit", "threshold", "time", "shape", "location", "mark", "observed"]
Sign: TypeAlias = Literal["positive", "real"]
#: Where an effect is looked for: among hypotheses that are fitted; among those of rigs alone, where model error and not
#: noise decides; as a structure that is fitted beside them and is no effect; in the operating point that every fit has;
#: in the samples; in the residual; in the recomputed law; in models of equations alone.
Sought: TypeAlias = Literal[
    "equations", "hypothesis", "rig", "structure", "operating point", "samples", "residual", "law"
]

#: How usual it is that a model lacks an effect which its rig has.
Prior: TypeAlias = Literal["expected", "usual", "possible", "rare"]
#: The same as odds: what is expected is as likely as not, and a fifth from word to word, for nobody knows them better.
PRIOR_ODDS: Mapping[Prior, float] = MappingProxyType({"expected": 1.0, "usual": 0.2, "possible": 0.04, "rare": 0.008})


def lacking(expected: str = "", usual: str = "", possible: str = "", rare: str = "") -> Mapping[str, Prior]:
    """Return how usual it is that a model lacks an effect, by kind of rig.

    Parameters
    ----------
    expected, usual, possible, rare : str
        Kinds of rigs (:mod:`autotune.effects.rigs`; ``any`` for all others), with spaces between them.
    """
    said: dict[Prior, str] = {"expected": expected, "usual": usual, "possible": possible, "rare": rare}
    return MappingProxyType({rig: word for word, rigs in said.items() for rig in rigs.split()})


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A parameter of an effect.

    Attributes
    ----------
    name : str
        Its name in files.
    unit : str
        Unit, with ``{u}``, ``{f}``, ``{v}``, ``{y}`` for the command's, the plant input's, the speed's and the
        measurement's.
    role : str
        What it is to a search, see :data:`Role`.
    sign : {"positive", "real"}
        Whether it is searched on a logarithmic or a linear scale.
    neutral : float, optional
        Value with which it does nothing, taken where a model does not give it; without one it must be given.
    nonzero : bool
        Whether the effect's equation divides by it: a value that is not above zero is refused.
    size_with : tuple of str
        Parameters that have one size together, as the two parts of a sinusoid: one of them may be near zero.
    held : callable, optional
        Given an effect's values, whether a fit leaves this one as it is.
    turns : bool
        Whether it acts by the angle that it adds up until a recording's end: the longer the recording, the smaller are
        the steps in which it is searched.
    """

    name: str
    unit: str
    role: Role
    sign: Sign = "positive"
    neutral: float | None = None
    nonzero: bool = False
    size_with: tuple[str, ...] = ()
    held: Callable[[Values], bool] | None = None
    turns: bool = False

    @property
    def is_time_of_change(self) -> bool:
        """Whether it is the time at which something changes."""
        return self.role == "location" and self.unit == "s"

    @property
    def is_fitted(self) -> bool:
        """Whether a fit moves it; else a direct search has set it."""
        return self.role not in ("location", "mark", "observed")


@dataclass(frozen=True, kw_only=True)
class Extent:
    """How far recordings go: the span of their commands [u unit], the longest one's duration, and a sample time [s]."""

    span: float
    duration_s: float
    dt_s: float


@dataclass(frozen=True, kw_only=True)
class SignalSizes:
    """Sizes of the signals in the recordings, from which starting values follow.

    Attributes
    ----------
    w, f, v, x, y : float
        Largest deviation of command, plant input, speed, position (or level) and reading from the operating point.
    w_low, w_high, y_low, y_high, x_offset : float
        Extremes of command and reading, and the reading at the operating point.
    f_peak : float
        Largest plant input.
    gain : float
        From plant input to speed or level.
    lag_s, dt_s, duration_s : float
        Dominant time constant, sample time, and length of the longest recording.
    levels : int
        Number of levels one above the other, 0 where the plant has a speed.
    turn : float
        One turn in the measurement's unit where that is an angle and a spring pulls the position back, else 0.
    static : bool
        Whether the plant is a law without dynamics.
    """

    w: float
    f: float
    v: float
    x: float
    y: float
    w_low: float
    w_high: float
    y_low: float
    y_high: float
    x_offset: float
    f_peak: float
    gain: float
    lag_s: float
    dt_s: float
    duration_s: float
    levels: int
    turn: float = 0.0
    static: bool = False


class Chain(Protocol):
    """What an effect may ask of the linear chain that it is put into."""

    @property
    def is_mechanical(self) -> bool:
        """Whether the plant has a speed."""

    @property
    def has_travel(self) -> bool:
        """Whether it has a position beside its speed."""

    @property
    def is_static(self) -> bool:
        """Whether the plant is a law without dynamics."""

    @property
    def is_integrating(self) -> bool:
        """Whether the chain has a pole at the origin."""

    @property
    def has_actuator_lag(self) -> bool:
        """Whether an actuator's first-order lag stands before the plant."""

    @property
    def has_position_state(self) -> bool:
        """Whether the position or level is itself a state."""


@dataclass(frozen=True, kw_only=True)
class Structure:
    """A property that a chain must have, with what is said where it has not."""

    holds: Callable[[Chain], bool]
    otherwise: str


ANY = Structure(holds=lambda chain: True, otherwise="")
MECHANICAL = Structure(holds=lambda chain: chain.is_mechanical, otherwise="friction and drag need a speed")
RUBBING = Structure(
    holds=lambda chain: chain.is_mechanical or chain.is_static,
    otherwise="dry friction needs a speed, or a plant that is a force over a speed",
)
TRAVEL = Structure(holds=lambda chain: chain.has_travel, otherwise="stiffness and torques need a speed and a position")
LEVEL = Structure(
    holds=lambda chain: not (chain.is_mechanical or chain.is_integrating or chain.is_static),
    otherwise="it needs a plant that settles at a level",
)
INTEGRATING = Structure(holds=lambda chain: chain.is_integrating, otherwise="it needs a plant that integrates")
POSITION_STATE = Structure(
    holds=lambda chain: chain.has_position_state, otherwise="a hard stop needs a position that is a state"
)
ACTUATOR_LAG = Structure(
    holds=lambda chain: chain.has_actuator_lag, otherwise="an asymmetric lag needs an actuator of first order"
)


#: Different commands up to which a command takes few: their answers are kept, and steps over them are tried closely.
FEW_LEVELS = 100


class Scan(Protocol):
    """What a direct search for starting values may look at: the recordings under a fit without the effect."""

    @property
    def sizes(self) -> SignalSizes:
        """Sizes of the signals."""

    @property
    def durations_s(self) -> Sequence[float]:
        """Length of every recording [s]."""

    @property
    def slowest_lag_s(self) -> float:
        """Slowest time constant of the nominal chain [s]."""

    def predicted(self, values: Sequence[tuple[float, ...]]) -> list[tuple[float, tuple[float, ...]]]:
        """Return the decrease of chi-square that the first order predicts for the effect with each set of values.

        Beside it stand the values with their amplitudes made as small as the first order needs them.
        """

    def together(self, values: Sequence[tuple[float, ...]]) -> tuple[float, FloatArray]:
        """Return the decrease that sets of values predict together, and the factor of each of them."""

    def lines_over_time(self) -> tuple[FloatArray, FloatArray]:
        """Return frequencies [Hz] and the residual's power there, all recordings in one phase."""

    def influence(self) -> tuple[FloatArray, FloatArray]:
        """Return the commands, and how chi-square would fall with more of each."""

    @property
    def commands(self) -> FloatArray:
        """Commands in the recordings."""

    @property
    def levels(self) -> FloatArray:
        """Different commands in the recordings, smallest first."""

    @property
    def operating_command(self) -> float:
        """Command at the nominal operating point."""

    def commanded(self, changes: FloatArray) -> FloatArray:
        """Return the decrease that each row of (K, L) changes of the L levels predicts."""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """What a fit made of an effect, beside what the recordings resolve.

    Attributes
    ----------
    values : mapping
        Its parameters.
    travelled : float
        Span of the positions or levels.
    noise_sd : float
        Standard deviation of the measurement noise.
    mechanical : bool
        Whether the plant has a speed and a position.
    """

    values: Values
    travelled: float
    noise_sd: float
    mechanical: bool


#: A limit that nothing reaches.
NEVER = 1e18


def ends(unit: str) -> tuple[Quantity, Quantity]:
    """Return the two marks beyond which a law adds what it adds there."""
    return (
        Quantity(name="low", unit=unit, role="mark", sign="real", neutral=-NEVER),
        Quantity(name="high", unit=unit, role="mark", sign="real", neutral=NEVER),
    )


Starts: TypeAlias = Callable[[SignalSizes], list[tuple[float, ...]]]


def no_starts(sizes: SignalSizes) -> list[tuple[float, ...]]:
    """Return no starting value: a direct search finds them, or nothing is fitted."""
    return []


@dataclass(frozen=True, kw_only=True)
class EffectKind:
    """An effect that may be missing in a model, with all that is known of it.

    Attributes
    ----------
    name : str
        PLACE.EFFECT.
    words : tuple of two str
        What it is, in a few words for a diagram, and as the main clause of a sentence.
    equation : str
        What it does, for people.
    parameters : tuple of Quantity
        Its parameters.
    reference : str
        Where the equation is from.
    sought : str
        Where it is looked for, see :data:`Sought`.
    lines : tuple of Line
        What it does in the compiled simulation. Kinds act in the order in which their place's file lists them.
    memory : Memory, optional
        What its lines keep from step to step.
    linear : LinearPart, optional
        What it makes of the chain.
    in_equations : InEquations, optional
        How it acts in a model of equations, and which values are tried there; without it it is not tried there.
    sub_steps : int
        Sub-steps per sample that it needs at least.
    needs, suits : Structure
        Chain that it can be simulated in, and that a search tries it on.
    possible : callable, optional
        Given values and model; returns what is wrong with them, or "".
    starts : callable
        Starting values for a fit, from the sizes of the signals.
    search : callable, optional
        Starting values by direct search, see :class:`Scan`.
    lasting : bool
        Whether that search is long and its result hardly depends on what else is fitted: it is made once.
    moves : callable, optional
        Given values, the recordings' extent and a share, 1 at first; returns values around them that no derivative
        leads to, the nearer the smaller the share is, and none where they are as near as matters.
    rough : bool
        Whether thresholds make local minima: a fit takes more steps.
    impacts : bool
        Whether it makes the plant hit something: after an impact no first order tells anything, the least change of any
        number shows, and start states are found anew.
    stand_in : callable, optional
        Whether fitted numbers make it the same as a simpler effect.
    acts_in : callable, optional
        Recording (-1 for all) and time from which it acts; always and everywhere by default.
    readable : callable, optional
        Its parameters as people name them.
    at_a_time : bool
        Whether it counts from a recording's beginning: seen once, it is nothing that the next recording has too.
    steps : bool
        Whether it makes steps of the readings that no derivative of a start state leads through.
    flattens : bool
        Whether readings stand still where it acts: what scatters in front of it is cut off with the rest.
    uneven : bool
        Whether it makes some rows' noise larger than others': then the residual's variance says nothing of a model.
    late_stamps : bool
        Whether it says that stamps are wrong where they are uneven: a simulation then runs at even times.
    excludes : tuple of str
        Effects that are not looked for where this one is seen in the samples.
    same : tuple of str
        Effects that cannot be told apart from it with command and measurement alone; itself not counted. Drifts of
        load and sensor are the same on a chain that settles; on others one of them simply explains nothing.
    like : tuple of str
        Effects that differ from it to second order in their size, as a lag and a dead time do in their length: one of
        them may be likely where none is alone.
    recoordinates : bool
        Whether it is a change of the plant's coordinates: where no command moves, nothing tells it from the plant.
    includes : tuple of str
        Effects that are this one with numbers at their ends: neither is added beside the other.
    places : tuple of str
        Where it may sit, several where command and measurement cannot say; its own by default.
    goes_on : callable, optional
        Given values, the plant's ``gain`` among them, and how far its signal is from the operating point, whether its
        law goes on there beyond what was recorded: it neither turns back nor feeds what it acts on. Its last two
        parameters are then :func:`ends`, marks of an extended model beyond which it adds what it adds there.
    odds : mapping
        How usual it is that a rig of a kind (:mod:`autotune.effects.rigs`; ``any`` for all others) has it and its
        model lacks it, in the words of :data:`PRIOR_ODDS`; rare in kinds that are not given.
    """

    name: str
    words: tuple[str, str] = ("", "")
    equation: str = ""
    parameters: tuple[Quantity, ...] = ()
    reference: str = ""
    sought: Sought = "hypothesis"
    lines: tuple[Line, ...] = ()
    memory: Memory | None = None
    linear: LinearPart | None = None
    in_equations: InEquations | None = None
    sub_steps: int = 1
    needs: Structure = ANY
    suits: Structure = ANY
    possible: Callable[[Values, Model], str] | None = None
    starts: Starts = no_starts
    search: Callable[[Scan], list[tuple[float, ...]]] | None = None
    lasting: bool = False
    moves: Callable[[Values, Extent, float], list[Values]] | None = None
    rough: bool = False
    impacts: bool = False
    stand_in: Callable[[Fitted], bool] | None = None
    acts_in: Callable[[Values], tuple[int, float]] | None = None
    readable: Callable[[Mapping[str, Parameter]], dict[str, Parameter]] | None = None
    at_a_time: bool = False
    steps: bool = False
    flattens: bool = False
    uneven: bool = False
    late_stamps: bool = False
    excludes: tuple[str, ...] = ()
    same: tuple[str, ...] = ()
    like: tuple[str, ...] = ()
    recoordinates: bool = False
    includes: tuple[str, ...] = ()
    places: tuple[str, ...] = ()
    goes_on: Callable[[Values, float], bool] | None = None
    odds: Mapping[str, Prior] = field(default_factory=dict, hash=False, compare=False)

    def prior_odds(self, rig: str) -> float:
        """Return the prior odds that a model of a kind of rig lacks it."""
        return PRIOR_ODDS[self.odds.get(rig, self.odds.get("any", "rare"))]

    @property
    def place(self) -> str:
        """The place in the effect's name."""
        return self.name.partition(".")[0]

    @property
    def may_sit(self) -> tuple[str, ...]:
        """Places where it may sit."""
        return self.places or (self.place,)

    @property
    def is_simulated(self) -> bool:
        """Whether a simulation can have it."""
        return bool(self.lines) or self.linear is not None

    @property
    def is_event(self) -> bool:
        """Whether it happens at a time that is searched."""
        return any(q.is_time_of_change for q in self.parameters)

    @cached_property
    def is_signed(self) -> bool:
        """Whether it may act in either direction: a number that is fitted has either sign."""
        return any(q.sign == "real" for q in self.parameters if q.is_fitted)

    @cached_property
    def stages(self) -> frozenset[StageName]:
        """Stages at which its lines act."""
        return frozenset(line.stage for line in self.lines)

    @cached_property
    def amplitudes(self) -> frozenset[str]:
        """Parameters that it is about proportional to."""
        return frozenset(q.name for q in self.parameters if q.role == "amplitude")

    def quantity(self, name: str) -> Quantity | None:
        """Return a parameter by its name."""
        return next((q for q in self.parameters if q.name == name), None)
