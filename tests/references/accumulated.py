"""Criteria of the law of success costs by backward induction over accumulated cost.

Costs are small integers. A layer is the set of states at one accumulated cost; moves that cost
nothing stay in it, so that each layer is a process of its own, solved by policy iteration. What
lies beyond the last layer is known exactly (by the goal probability, by a linear cost) or within
bounds that are stated. Dead-ends and wandering for ever earn nothing.

*Least failure* means: only actions that keep the greatest goal probability, found in exact
fractions, and only policies that leave every free loop.
"""

from collections.abc import Callable, Mapping
from math import ceil, exp, floor

from references.chain import Action, PlainModel, State, mean, start_distribution
from references.iteration import Kept, greatest, homeward, hopeful, kept_actions, success

Start = State | Mapping[State, float]
Layer = dict[State, float]

TIE = 1e-11
"""A probability this near to the level counts as equal to it: sweeps are right to 1e-12."""
VANISHED = 36.0
"""exp(-36) = 2e-16: utilities beyond this exponent are below rounding."""


def sweep(
    model: PlainModel,
    kept: Kept,
    layers: int,
    arrival: Callable[[int], float],
    beyond: Callable[[State, int], float],
) -> list[Layer]:
    """Greatest expected reward from each state in each of the layers 0, ..., layers - 1.

    `arrival(cost)` is earned at the goal; `beyond(state, cost)` stands for all that follows a cost
    of `layers` or more.
    """
    first = homeward(model, kept)
    table: dict[int, Layer] = {}
    for spent in reversed(range(layers)):
        reward: dict[State, dict[Action, float]] = {}
        moves: dict[State, dict[Action, dict[State, float]]] = {}
        for state, actions in kept.items():
            reward[state], moves[state] = {}, {}
            for action in actions:
                earned, inside = 0.0, {}
                for p, successor, cost in model.choices[state][action]:
                    after = spent + int(cost)
                    if successor in model.goals:
                        earned += p * arrival(after)
                    elif successor not in kept:
                        continue
                    elif after >= layers:
                        earned += p * beyond(successor, after)
                    elif after > spent:
                        earned += p * table[after][successor]
                    else:
                        inside[successor] = inside.get(successor, 0.0) + p
                reward[state][action], moves[state][action] = earned, inside
        table[spent] = greatest(first, reward, moves)
    return [table[spent] for spent in range(layers)]


def at_start(model: PlainModel, start: Start, values: Layer, at_goal: float) -> float:
    """The mean over the start, with the worth of starting at a goal; 0 at dead-ends."""
    return mean(start_distribution(start), values | dict.fromkeys(model.goals, at_goal))


def goal_probability(model: PlainModel, start: Start) -> float:
    """The greatest goal probability from the start."""
    return mean(start_distribution(start), {s: float(p) for s, p in success(model).items()})


def expected_utility(
    model: PlainModel,
    start: Start,
    utility: Callable[[int], float],
    goal_bonus: float,
    layers: int,
    at_infinity: float = 0.0,
    limit: float | None = None,
) -> tuple[float, float]:
    """Lower and upper bound of max E[u(C)] + bonus * Pr(goal).

    Beyond the layers a run that succeeds earns between `limit` (that of u; `at_infinity` unless
    told) and u(layers). Both ends are attained by a policy of greatest goal probability.
    """
    best = {s: float(p) for s, p in success(model).items()}
    found = []
    for last in (at_infinity if limit is None else limit, utility(layers)):
        worth = last - at_infinity + goal_bonus
        values = sweep(
            model,
            hopeful(model),
            layers,
            lambda cost: utility(cost) - at_infinity + goal_bonus,
            lambda state, _, worth=worth: worth * best[state],
        )
        at_goal = utility(0) - at_infinity + goal_bonus
        found.append(at_infinity + at_start(model, start, values[0], at_goal))
    return found[0], found[1]


def exponential_utility(
    model: PlainModel, start: Start, risk_factor: float, goal_bonus: float
) -> float:
    """The optimum of eGUBS, right to about 1e-15 + rounding."""

    def utility(cost: int) -> float:
        return exp(risk_factor * cost)

    layers = ceil(VANISHED / -risk_factor)
    return expected_utility(model, start, utility, goal_bonus, layers)[0]


def reach_within(
    model: PlainModel, start: Start, bound: int, *, least: bool = False
) -> list[float]:
    """Max Pr(goal at cost <= B) for B = 0, ..., bound; `least`: among policies of least failure."""
    kept = kept_actions(model) if least else hopeful(model)
    table = sweep(model, kept, bound + 1, lambda cost: float(cost <= bound), lambda *_: 0.0)
    return [at_start(model, start, values, 1.0) for values in table[::-1]]


def quantile(model: PlainModel, start: Start, level: float) -> int | None:
    """The least B with Pr(C <= B) >= level * Pr(goal) at least failure; None without a goal.

    The bound on B is doubled until it is enough: a policy of least failure loses its mass
    geometrically, so for a level below 1 there is such a B.
    """
    probability = goal_probability(model, start)
    if probability == 0.0:
        return None
    needed = level * probability
    bound = 8
    while (reached := reach_within(model, start, bound, least=True))[-1] < needed - TIE:
        bound *= 2
    return next(b for b, p in enumerate(reached) if p >= needed - TIE)


def success_cost(model: PlainModel) -> Layer:
    """The least E[total cost; goal] at least failure from each state.

    A cost counts with the probability of success that follows it.
    """
    kept, best = kept_actions(model), success(model)
    reward: dict[State, dict[Action, float]] = {s: {} for s in kept}
    moves: dict[State, dict[Action, dict[State, float]]] = {s: {} for s in kept}
    for state, actions in kept.items():
        for action in actions:
            outcomes = model.choices[state][action]
            reward[state][action] = -sum(p * cost * float(best[s]) for p, s, cost in outcomes)
            inside: dict[State, float] = {}
            for p, s, _ in outcomes:
                if s in kept:
                    inside[s] = inside.get(s, 0.0) + p
            moves[state][action] = inside
    return {s: -v for s, v in greatest(homeward(model, kept), reward, moves).items()}


def shortfall(model: PlainModel, start: Start, most: int) -> list[float]:
    """The least E[(C - z)^+; goal] at least failure, for z = 0, ..., most.

    Beyond z the excess is linear in the cost, so a policy of the state alone is optimal there: the
    tail is exact. It depends on z - cost only, so one sweep answers for every z.
    """
    best, onward = success(model), success_cost(model)

    def beyond(state: State, cost: int) -> float:
        return -((cost - most) * float(best[state]) + onward[state])

    table = sweep(model, kept_actions(model), most, lambda c: -max(c - most, 0.0), beyond)
    table.append({s: -v for s, v in onward.items()})
    return [-at_start(model, start, values, 0.0) for values in table[::-1]]


def conditional_value_at_risk(model: PlainModel, start: Start, level: float) -> float | None:
    """The least CVaR of C given success at least failure; None without a goal.

    z is at most the optimum, hence at most the value at z = 0.
    """
    probability = goal_probability(model, start)
    if probability == 0.0:
        return None
    share = (1.0 - level) * probability
    most = floor(shortfall(model, start, 0)[0] / share) + 1
    return min(z + excess / share for z, excess in enumerate(shortfall(model, start, most)))
