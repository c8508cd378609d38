"""One episode of a policy in a Gymnasium environment, step by step, checked against the table."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray
from ssp_lp.errors import ModelError
from ssp_lp.io.environments.gym_environments import EnvironmentSSP, plain
from ssp_lp.model.graph.reachability import dead_ends
from ssp_lp.policies.mixed import MixedPolicy
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED, Policy


class _Player:
    """A policy whose decisions and memories are asked for once, then kept."""

    def __init__(self, policy: Policy, rng: np.random.Generator) -> None:
        self._policy, self._rng = policy, rng
        self._decisions: dict[tuple[int, int], tuple[IntArray, FloatArray]] = {}
        self._memories: dict[tuple[int, int, int, float], int] = {}

    def start(self, state: int) -> int:
        """The memory at the start."""
        return int(self._policy.start_memory(np.array([state]))[0])

    def decide(self, state: int, memory: int) -> int:
        """A pair, or GIVE_UP_CODE."""
        key = state, memory
        if key not in self._decisions:
            found = self._policy.branches(np.array([state]), np.array([memory]))
            self._decisions[key] = found.pair, np.cumsum(found.probability)
        pairs, cumulative = self._decisions[key]
        drawn = 0
        if len(pairs) > 1:
            level = self._rng.random() * cumulative[-1]
            drawn = int(np.searchsorted(cumulative, level, side="right"))
        pair = int(pairs[min(drawn, len(pairs) - 1)])
        if pair == UNDECIDED:
            name = self._policy.model.states[state]
            raise ModelError(f"the policy has no decision in state {name!r}")
        return pair

    def remember(self, memory: int, pair: int, successor: int, cost: float) -> int:
        """The memory after a step."""
        key = memory, pair, successor, cost
        if key not in self._memories:
            step = np.array([memory]), np.array([pair]), np.array([successor]), np.array([cost])
            self._memories[key] = int(self._policy.remember(*step)[0])
        return self._memories[key]


@dataclass(frozen=True)
class End:
    """How an episode ended."""

    name: str  # a count of the report
    cost: float
    steps: int


class Party:
    """The players of a lottery, and what their episodes have in common."""

    def __init__(self, policy: MixedPolicy, rng: np.random.Generator, most: int) -> None:
        """Play episodes of at most so many steps."""
        self.model = cast(EnvironmentSSP, policy.model)
        self.most, self._rng = most, rng
        self.over = dead_ends(policy.model) | policy.model.goal_mask  # [states]
        self._players = [_Player(member, rng) for member in policy.policies]
        self._weights = policy.weights
        self._known: set[tuple[int, int]] = set()  # pairs and successors of the table
        self.cut_off = 0  # episodes that an environment did

    def begin(self, shown: Any) -> GymEpisode:
        """An episode in what an environment shows after its reset."""
        player = self._players[int(self._rng.choice(len(self._players), p=self._weights))]
        return GymEpisode(self, player, plain(shown))

    def check(self, pair: int, successor: int, terminated: bool) -> None:
        """Raise :class:`ModelError` if the table does not know of a step."""
        if (pair, successor) in self._known:
            return
        model = self.model
        listed = slice(int(model.outcome_offsets[pair]), int(model.outcome_offsets[pair + 1]))
        if successor not in model.successors[listed]:
            raise ModelError(
                f"{model.describe_pair(pair)} led to {model.states[successor]!r}, which the "
                "environment's table does not list: env.unwrapped.P does not tell all"
            )
        if terminated and not self.over[successor]:
            raise ModelError(
                f"the environment terminated in {model.states[successor]!r} against its table"
            )
        self._known.add((pair, successor))


class GymEpisode:
    """An episode: where it stands, and how it ended, once it has."""

    def __init__(self, party: Party, player: _Player, shown: Hashable) -> None:
        self._party, self._player, self._shown = party, player, shown
        self._state, self._cost, self._steps = party.model.index_of(shown), 0.0, 0
        self._pair = self._memory = 0
        self.end: End | None = None
        if party.over[self._state]:
            self._finish(self._state)
        else:
            self._memory = player.start(self._state)

    def action(self) -> Hashable:
        """What the policy does; where it gives up the episode has ended."""
        self._pair = self._player.decide(self._state, self._memory)
        if self._pair == GIVE_UP_CODE:
            self.end = End("gave_up", self._cost, self._steps)
            return None
        return self._party.model.action_of(self._pair)

    def observe(self, shown: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Take what the environment shows after a step."""
        party, model, there = self._party, self._party.model, plain(shown)
        successor = model.index_of(model.label(there, bool(terminated)))
        party.check(self._pair, successor, bool(terminated))
        action = model.action_of(self._pair)
        paid = float(model.step_cost(self._shown, action, there, float(reward)))
        self._cost += paid
        self._steps += 1
        if party.over[successor]:
            self._finish(successor)
        elif truncated or self._steps == party.most:
            party.cut_off += bool(truncated)
            self.end = End("truncated", self._cost, self._steps)
        else:
            self._memory = self._player.remember(self._memory, self._pair, successor, paid)
        self._state, self._shown = successor, there

    def _finish(self, state: int) -> None:
        name = "goal" if self._party.model.goal_mask[state] else "failed"
        self.end = End(name, self._cost, self._steps)
