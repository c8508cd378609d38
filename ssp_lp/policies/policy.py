"""What every policy can do: decide and remember, for many episodes at once, and be played."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal, NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, ReadOnlyCopies
from ssp_lp.errors import ModelError, check_whole, in_short
from ssp_lp.model import SSP

if TYPE_CHECKING:
    from ssp_lp.policies.episodes import Episode, EpisodeBatch

Randomness = np.random.Generator | int
"""A generator, or the seed of a new one."""


def generator_of(rng: Randomness) -> np.random.Generator:
    """The generator itself, or a new one with this seed.

    Raises:
        ModelError: neither a generator nor a whole number >= 0.
    """
    if isinstance(rng, np.random.Generator):
        return rng
    if isinstance(rng, (int, np.integer)) and not isinstance(rng, bool) and rng >= 0:
        return np.random.default_rng(int(rng))
    raise ModelError(f"rng must be a numpy.random.Generator or a seed such as 0, not {rng!r}")


class Decision(enum.Enum):
    """What a policy may answer besides an action of the model."""

    GIVE_UP = "give up"


GIVE_UP: Final = Decision.GIVE_UP

GIVE_UP_CODE: Final = -1
"""Stands for :data:`GIVE_UP` in arrays of pairs."""

UNDECIDED: Final = -2
"""Stands in arrays of pairs for states in which a policy never has to act."""


MOST_EPISODES: Final = 100_000_000
"""Played side by side: some ten gigabytes."""

World = Literal["model", "other"]
"""Where episodes are played: in the policy's model, or in another world that it stands for."""


class Branches(NamedTuple):
    """The possible decisions in several situations at once, one entry per branch."""

    situation: IntArray  # [branches] position among the situations asked about
    pair: IntArray  # [branches] pair of the model, or GIVE_UP_CODE
    probability: FloatArray  # [branches]


@dataclass(frozen=True, eq=False)
class CostLayers:
    """A decision for each (layer, state); beyond the last layer a tail is followed for good."""

    decision: IntArray  # [layers, states] position in the state's pairs, or a code
    tails: IntArray  # [tails, states] pair, or a code
    tail_at: Callable[[int], IntArray]  # layer beyond the last one -> tail of each state, [states]
    costs: FloatArray  # [classes] the distinct costs of a step, increasing
    leads: Callable[[int], IntArray]  # layer -> layers that each class of step passes, [classes]
    unit: float | None  # cost of a layer; None: layers are levels that totals are rounded to
    width: int  # 1 + the most layers that a step passes
    rounds_up: bool = False  # whether steps that cost no whole number of units pass one layer more

    @property
    def count(self) -> int:
        """Number of layers of the policy."""
        return len(self.decision)


class Playable(ReadOnlyCopies, ABC):
    """Mix-in of the policies that a person's own loop can drive: they start episodes.

    Example:
        >>> from ssp_lp import SSP, DeterministicPolicy
        >>> model = SSP.from_transitions({"door": {"open": [(1.0, "out", 2.0)]}}, goal={"out"})
        >>> episode = DeterministicPolicy.from_actions(model, {"door": "open"}).start()
        >>> episode.action("door")
        'open'
        >>> episode.observe("out", 2.0)
        >>> episode.action("out") is None
        True
    """

    def start(self, rng: Randomness | None = None, *, world: World = "model") -> Episode:
        """A new episode of the policy, beside any others; ``rng`` draws the lottery and actions.

        The policy is data and stays as it is: all that an episode remembers is its own.

        Args:
            rng: a generator, which goes on from episode to episode, or a seed, with which every
                episode begins afresh.
            world: "model" where episodes are played in the policy's model: steps that it does not
                have, a state other than the one observed and a second observation of one action
                are refused. "other" where they are not, as in a simulator or a machine.

        Raises:
            ModelError: a lottery without a generator.
        """
        from ssp_lp.policies.episodes import Episode

        return Episode(self.start_many(1, rng, world=world))

    def start_many(
        self, episodes: int, rng: Randomness | None = None, *, world: World = "model"
    ) -> EpisodeBatch:
        """Many new episodes of the policy side by side, whose ``actions`` are asked for together.

        Args:
            episodes: how many.
            rng: as of :meth:`start`.
            world: as of :meth:`start`.

        Raises:
            ModelError: no episodes, or a lottery without a generator.
        """
        from ssp_lp.policies.episodes import EpisodeBatch

        check_whole("episodes", episodes, most=MOST_EPISODES)
        drawn = None if rng is None else generator_of(rng)
        return EpisodeBatch(*self.draw(episodes, drawn), drawn, world)

    @abstractmethod
    def draw(
        self, episodes: int, rng: np.random.Generator | None
    ) -> tuple[tuple[Policy, ...], IntArray]:
        """The members of the lottery, and the position of the one that plays each episode."""


class Policy(Playable):
    """A policy without or with a finite memory, which starts, decides and remembers.

    The three abstract methods work on many episodes at once. Memory is an integer whose meaning
    is the policy's own.
    """

    model: SSP
    is_stationary: ClassVar[bool] = False  # whether there is no memory at all

    def draw(
        self, episodes: int, rng: np.random.Generator | None
    ) -> tuple[tuple[Policy, ...], IntArray]:
        """The policy itself, for all episodes."""
        return (self,), np.zeros(episodes, dtype=np.int64)

    @property
    def step_limit(self) -> int | None:
        """The steps within which it was made to reach the goal; None: it knows of none."""
        return None

    @abstractmethod
    def start_memory(self, states: IntArray) -> IntArray:
        """Memory at the start of episodes that begin in these states, [episodes]."""

    def layers(self) -> CostLayers | None:
        """The policy layer by layer of the cost paid; None where its memory is another one."""
        return None

    @abstractmethod
    def branches(self, states: IntArray, memory: IntArray) -> Branches:
        """The decisions with their probabilities in each (state, memory), [situations]."""

    @abstractmethod
    def remember(
        self, memory: IntArray, pairs: IntArray, successors: IntArray, costs: FloatArray
    ) -> IntArray:
        """Memory after taking these pairs to these successors at these costs, [episodes]."""

    def sample(
        self, states: IntArray, memory: IntArray, rng: np.random.Generator | None
    ) -> IntArray:
        """Draw one decision per episode: a pair or GIVE_UP_CODE, [episodes].

        Raises:
            ModelError: the policy has no decision in one of the states.
        """
        found = self.branches(states, memory)
        if len(found.situation) == len(states):  # one branch each: nothing to draw
            pairs = found.pair
        else:
            if rng is None:
                raise ModelError("a stochastic policy needs a random generator: start(rng)")
            cumulative = np.cumsum(found.probability)
            first = np.searchsorted(found.situation, np.arange(len(states)))
            before = np.concatenate([[0.0], cumulative])[first]
            last = np.concatenate([first[1:], [len(found.situation)]]) - 1
            drawn = np.searchsorted(cumulative, before + rng.random(len(states)), side="right")
            pairs = found.pair[np.clip(drawn, first, last)]
        if (pairs == UNDECIDED).any():
            state = self.model.states[int(states[int(np.argmax(pairs == UNDECIDED))])]
            raise ModelError(f"the policy has no decision in state {state!r}")
        return pairs


def check_policies(policies: Iterable[object]) -> None:
    """Raise :class:`ModelError` unless all of these are policies; a solution has one."""
    for one in policies:
        if not isinstance(one, Policy):
            told = "; pass solution.policy" if hasattr(one, "policy") else ""
            raise ModelError(f"a policy is needed, not {in_short(one)}{told}")


def check_costs(costs: FloatArray | float) -> None:
    """Raise :class:`ModelError` unless costs of steps are numbers >= 0, and finite."""
    paid = np.atleast_1d(costs)
    wrong = ~((paid >= 0.0) & np.isfinite(paid))
    if wrong.any():
        cost = float(paid[int(np.argmax(wrong))])
        raise ModelError(f"observed cost {cost!r} must be >= 0 and finite")
