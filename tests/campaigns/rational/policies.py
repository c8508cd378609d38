"""All deterministic stationary policies of a small model, each evaluated in exact fractions.

A policy decides at the states that it visits, to act or to stop. Which of them count, and what
failing costs, depends on where a policy may give up:

* "anywhere", "attention": the episode is over where the policy cannot reach the goal any more;
* "dead_ends": it goes on until a true dead-end; wandering for ever at a cost has no finite cost.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

from tests.campaigns.rational.models import GOAL, START, Model, Outcome, Rows

STOP = "<stop>"
Moves = Mapping[str, Sequence[Outcome]]
Masses = dict[str, Fraction]


@dataclass(frozen=True)
class Totals:
    """Expected costs up to the places where an episode ends, and the mass that ends at each."""

    cost: Fraction
    second: Fraction
    ends: Masses  # without the goal


@dataclass(frozen=True)
class Evaluated:
    """One policy: exact numbers from the start."""

    failure: Fraction
    success_cost: Fraction  # E[total cost; goal]
    stops: frozenset[str]
    until_hopeless: Totals
    until_dead: Totals | None  # None: it stops, or it pays for ever
    second_until_dead: Totals | None  # None: as above, the second cost counted as well


class Exact:
    """A model with its graph facts and all its policies."""

    def __init__(self, model: Model) -> None:
        self.model, self.rows = model, model.rows
        every = {
            s: [o for row in actions.values() for o in row] for s, actions in self.rows.items()
        }
        self.dead_ends = frozenset(self.rows) - reaching(every)
        self.attention = avoiding(self.rows)

    @cached_property
    def policies(self) -> list[Evaluated]:
        """Every policy, decisions to stop included."""
        return [self._evaluate(policy) for policy in self._expand({})]

    def charge(self, state: str, give_up: str, second: bool) -> Fraction:
        """What the failing step costs at the state in which failure has become certain."""
        actions = self.rows[state]
        if state not in self.dead_ends and give_up != "anywhere":
            inside = self.attention
            actions = {a: row for a, row in actions.items() if all(o[1] in inside for o in row)}
        return min((self._stage(state, a, second) for a in actions), default=Fraction(0))

    def _stage(self, state: str, action: str, second: bool) -> Fraction:
        """Expected cost of one step."""
        if second:
            return Fraction(self.model.second[state][action])
        return sum((p * cost for p, _, cost in self.rows[state][action]), Fraction(0))

    def _moves(self, policy: Mapping[str, str]) -> dict[str, Sequence[Outcome]]:
        """The outcomes played in each state; none where the policy stops or does not decide."""
        return {s: actions.get(policy.get(s, STOP), ()) for s, actions in self.rows.items()}

    def _expand(self, policy: dict[str, str]) -> Iterator[dict[str, str]]:
        """All ways to decide at the states that are visited."""
        for state in reachable(self._moves(policy)):
            if state not in policy and state not in self.dead_ends:
                for action in [*self.rows[state], STOP]:
                    yield from self._expand({**policy, state: action})
                return
        yield policy

    def _evaluate(self, policy: Mapping[str, str]) -> Evaluated:
        moves = self._moves(policy)
        visited = reachable(moves)
        home = reaching(moves)
        visits = expected_visits(moves, [s for s in visited if s in home])
        arriving = goal_probabilities(moves, list(visits))
        success_cost = sum(
            y * p * cost * arriving.get(t, Fraction(0))
            for s, y in visits.items()
            for p, t, cost in moves[s]
        )
        goal = arriving.get(START, Fraction(0))
        stops = frozenset(s for s in visited if policy.get(s) == STOP)
        until = self._totals(policy, moves, visits)
        dead = both = None
        if not stops:
            dead = self._until_dead(policy, moves, visited, (False,))
            both = self._until_dead(policy, moves, visited, (False, True))
        return Evaluated(1 - goal, Fraction(success_cost), stops, until, dead, both)

    def _until_dead(
        self, policy: Mapping[str, str], moves: Moves, visited: list[str], costs: tuple[bool, ...]
    ) -> Totals | None:
        """Totals up to true dead-ends and free wandering; None if the policy pays for ever."""
        live = [s for s in visited if s not in self.dead_ends]
        leaving = reaching(moves, self.dead_ends | {GOAL})
        wandering = [s for s in live if s not in leaving]
        # A state that cannot leave may still be on the way to a class: what it pays counts.
        closed = [s for s in wandering if all(s in ahead for ahead in _aheads(moves, s))]
        if any(self._stage(s, policy[s], second) > 0 for s in closed for second in costs):
            return None
        visits = expected_visits(moves, [s for s in live if s not in closed])
        return self._totals(policy, moves, visits)

    def _totals(self, policy: Mapping[str, str], moves: Moves, visits: Masses) -> Totals:
        """What expected visits pay, and where they end."""
        cost = sum((y * self._stage(s, policy[s], False) for s, y in visits.items()), Fraction(0))
        other = sum((y * self._stage(s, policy[s], True) for s, y in visits.items()), Fraction(0))
        ends: Masses = {} if START in visits else {START: Fraction(1)}
        for state, y in visits.items():
            for p, target, _ in moves[state]:
                if target not in visits and target != GOAL:
                    ends[target] = ends.get(target, Fraction(0)) + y * p
        return Totals(cost, other, ends)


def _aheads(moves: Moves, state: str) -> list[list[str]]:
    """What can be visited from each state that can be visited from a state."""
    return [reachable(moves, [s]) for s in reachable(moves, [state])]


def reachable(moves: Moves, start: Sequence[str] = (START,)) -> list[str]:
    """The non-goal states that paths visit, in order of discovery."""
    order = [s for s in start if s in moves]
    for state in order:
        for _, target, _ in moves[state]:
            if target in moves and target not in order:
                order.append(target)
    return order


def reaching(moves: Moves, targets: frozenset[str] = frozenset({GOAL})) -> frozenset[str]:
    """The states from which some path of at least one step leads to a target."""
    found: frozenset[str] = frozenset()
    while True:
        aims = found | targets
        more = frozenset(s for s in moves if any(t in aims for _, t, _ in moves[s]))
        if more == found:
            return found
        found = more


def avoiding(rows: Rows) -> frozenset[str]:
    """The states from which some policy surely avoids the goal."""
    inside = frozenset(rows)
    while True:
        kept = frozenset(
            s
            for s in inside
            if not rows[s] or any(all(t in inside for _, t, _ in row) for row in rows[s].values())
        )
        if kept == inside:
            return inside
        inside = kept


def expected_visits(moves: Moves, states: list[str]) -> Masses:
    """Expected visits of states that are surely left, from the start."""
    if START not in states:
        return {}
    matrix = _leaving(moves, states)
    turned = [list(column) for column in zip(*matrix, strict=True)]
    right = [Fraction(state == START) for state in states]
    return dict(zip(states, solve(turned, right), strict=True))


def goal_probabilities(moves: Moves, states: list[str]) -> Masses:
    """The goal probability from states that are surely left, 1 at the goal."""
    if not states:
        return {}
    right = [sum((p for p, t, _ in moves[s] if t == GOAL), Fraction(0)) for s in states]
    values = solve(_leaving(moves, states), right)
    return {**dict(zip(states, values, strict=True)), GOAL: Fraction(1)}


def _leaving(moves: Moves, states: list[str]) -> list[list[Fraction]]:
    """The matrix I - P of some states."""
    index = {state: i for i, state in enumerate(states)}
    matrix = [[Fraction(i == j) for j in range(len(states))] for i in range(len(states))]
    for state, i in index.items():
        for p, target, _ in moves[state]:
            if target in index:
                matrix[i][index[target]] -= p
    return matrix


def solve(matrix: list[list[Fraction]], right: list[Fraction]) -> list[Fraction]:
    """Gaussian elimination in fractions."""
    n, rows = len(right), [[*line, b] for line, b in zip(matrix, right, strict=True)]
    for k in range(n):
        pivot = next(i for i in range(k, n) if rows[i][k] != 0)
        rows[k], rows[pivot] = rows[pivot], rows[k]
        for i in range(k + 1, n):
            if rows[i][k] != 0:
                factor = rows[i][k] / rows[k][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    answer = [Fraction(0)] * n
    for k in reversed(range(n)):
        known = sum((rows[k][j] * answer[j] for j in range(k + 1, n)), Fraction(0))
        answer[k] = (rows[k][n] - known) / rows[k][k]
    return answer
