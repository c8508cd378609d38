"""Criteria of the law of success costs by enumeration, for tiny models whose runs end.

Every deterministic policy of (state, accumulated cost) gives a law of the cost on success. All
criteria are read off these laws; a budget needs lotteries over two of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from references import frontier
from references.accumulated import Start
from references.chain import PlainModel, policies, start_distribution
from references.frontier import Point

SAME = 1e-11
"""Probabilities nearer than this are one number computed twice."""


@dataclass(frozen=True)
class Law:
    """Of one policy: the probability of arriving at the goal at each cost."""

    mass: tuple[tuple[int, float], ...]

    @property
    def success(self) -> float:
        """The goal probability."""
        return sum(p for _, p in self.mass)

    def mean(self, worth: Callable[[int], float]) -> float:
        """E[worth(C); goal]."""
        return sum(p * worth(cost) for cost, p in self.mass)


def laws(model: PlainModel, start: Start) -> list[Law]:
    """The laws of all deterministic policies of (state, accumulated cost), without repetition.

    Live states must not be visited twice at different costs for ever: the product has to be finite.
    Dead-ends end the run.
    """
    begin = {(s, 0): mass for s, mass in start_distribution(start).items()}
    product = PlainModel(_product(model, begin), frozenset(), frozenset(), frozenset())
    found = set()
    for policy in policies(product, begin, lambda node: list(product.choices[node])):
        mass: dict[int, float] = {}
        flow = dict(begin)
        while flow:
            node, amount = flow.popitem()
            if node[0] in model.goals:
                mass[node[1]] = mass.get(node[1], 0.0) + amount
            elif node in policy:
                for p, successor, _ in product.choices[node][policy[node]]:
                    flow[successor] = flow.get(successor, 0.0) + amount * p
        found.add(Law(tuple(sorted((cost, round(p, 15)) for cost, p in mass.items() if p > 0))))
    return sorted(found, key=lambda law: law.mass)


def _product(model: PlainModel, begin) -> dict:
    """The live product nodes that some policy visits, with their moves."""
    table = {}
    pending = list(begin)
    for node in pending:
        state, spent = node
        if node in table or state in model.goals:
            continue
        actions = {} if state in model.dead_ends else model.choices[state]
        table[node] = {
            action: [(p, (s, spent + int(cost)), 0.0) for p, s, cost in outcomes]
            for action, outcomes in actions.items()
        }
        pending += [o[1] for outcomes in table[node].values() for o in outcomes]
    return table


def safest(found: Sequence[Law]) -> list[Law]:
    """The laws of least failure."""
    best = max(law.success for law in found)
    return [law for law in found if law.success >= best - SAME]


def expected_utility(
    found: Sequence[Law], utility: Callable[[int], float], goal_bonus: float, at_infinity: float
) -> float:
    """The greatest E[u(C)] + bonus * Pr(goal)."""
    return at_infinity + max(
        law.mean(lambda c: utility(c) - at_infinity + goal_bonus) for law in found
    )


def reach_within(found: Sequence[Law], bound: int, budget: float = 1.0) -> float:
    """The greatest Pr(goal at cost <= bound) of a lottery within the budget."""
    return -frontier.constrained_optimum(_points(found, lambda c: -float(c <= bound)), budget)


def quantile(found: Sequence[Law], level: float, budget: float = 1.0) -> int:
    """The least B with Pr(C <= B | goal) >= level of a lottery within the budget."""
    for bound in _costs(found):
        points = _points(found, lambda c, bound=bound: -float(c <= bound))
        ratio = frontier.constrained_ratio(points, budget)
        if ratio is not None and -ratio >= level - SAME:
            return bound
    raise ArithmeticError("no policy reaches the goal")


def conditional_value_at_risk(found: Sequence[Law], level: float, budget: float = 1.0) -> float:
    """The least z + E[(C - z)^+ | goal] / (1 - level) of a lottery within the budget."""
    values = []
    for z in _costs(found):
        points = _points(found, lambda c, z=z: z + max(c - z, 0) / (1.0 - level))
        values.append(frontier.constrained_ratio(points, budget))
    return min(value for value in values if value is not None)


def _costs(found: Sequence[Law]) -> list[int]:
    """The costs at which some policy arrives, and 0."""
    return sorted({cost for law in found for cost, _ in law.mass} | {0})


def _points(found: Sequence[Law], worth: Callable[[int], float]) -> list[Point]:
    """Each policy's failure and E[worth(C); goal]."""
    return [Point(1.0 - law.success, law.mean(worth)) for law in found]
