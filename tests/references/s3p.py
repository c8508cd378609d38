"""Case S by enumeration: least expected cost given that the goal is reached.

Failing episodes cost nothing; failing for real is possible at attention states only, and wandering
for ever there is the same. Policies are points (failure, cost on success), either stationary in
the state (enough at least failure) or in the product of state and accumulated cost (needed within
a budget; `references.s3p_program` does the same by a linear program and reaches further).

With a discount gamma: success is E[gamma^T; goal], cost on success is E[gamma^(T-1) r_T; goal].
"""

from collections.abc import Mapping

from references.chain import (
    Outcome,
    PlainModel,
    Policy,
    State,
    goal_weight,
    mean,
    moves_of,
    plain_model,
    policies,
    reaching,
    solve_chain,
    start_distribution,
)
from references.frontier import Point, least_failure

Start = State | Mapping[State, float]


def values(
    model: PlainModel, policy: Policy, discount: float | None
) -> tuple[dict[State, float], dict[State, float]]:
    """Success weight and cost on success of a stationary policy, from each state."""
    gamma = 1.0 if discount is None else discount
    moves = moves_of(model, policy)
    weight = goal_weight(model, moves, gamma)

    def reward(outcome: Outcome) -> float:
        """A cost paid now, weighed by E[gamma^(T-1); goal]: 1 on arrival, else gamma^T beyond."""
        return outcome[2] * weight.get(outcome[1], 0.0)

    return weight, solve_chain(moves, reaching(moves, model.goals), reward, gamma)


def stationary_points(
    model: PlainModel, start: Start, discount: float | None = None
) -> list[Point]:
    """(failure, cost on success) of every stationary policy that looks at states only."""
    begin = start_distribution(start)
    found = []
    for policy in policies(model, begin, lambda s: list(model.choices[s])):
        weight, cost = values(model, policy, discount)
        found.append(Point(1.0 - mean(begin, weight), mean(begin, cost)))
    return found


def at_least_failure(
    model: PlainModel, start: Start, discount: float | None = None
) -> tuple[float, float | None]:
    """The least failure, and the least conditional cost at it (None if the goal is out of reach).

    At least failure the accumulated cost does not matter, so stationary policies are enough.
    """
    every = stationary_points(model, start, discount)
    least = least_failure(every)
    if least >= 1.0 - 1e-12:
        return 1.0, None
    return least, min(cost for failure, cost in every if failure <= least + 1e-11) / (1 - least)


def goal_probability_range(
    model: PlainModel, start: Start, discount: float | None = None
) -> tuple[float, float]:
    """The least and the greatest success over all stationary policies, by enumeration."""
    failures = [failure for failure, _ in stationary_points(model, start, discount)]
    return 1.0 - max(failures), 1.0 - min(failures)


def product_points(
    model: PlainModel, start: Start, horizon: int, discount: float | None = None
) -> list[Point]:
    """(failure, cost on success) of every stationary policy of the product with accumulated cost.

    For tiny models. At and beyond the horizon the policy fails where it can, which is optimal once
    the horizon is at least c* + price; elsewhere the product must end by itself (acyclic models).
    """
    gamma = 1.0 if discount is None else discount
    begin = {(state, 0): mass for state, mass in start_distribution(start).items()}
    choices: dict[State, dict] = {}
    goals = {node for node in begin if node[0] in model.goals}
    order = [node for node in begin if node not in goals]
    seen = set(begin)
    for node in order:  # which grows
        state, spent = node
        over = spent >= horizon and state in model.attention
        choices[node] = {
            action: [(p, (to, spent + int(cost)), 0.0) for p, to, cost in outcomes]
            for action, outcomes in ({} if over else model.choices[state]).items()
        }
        ahead = dict.fromkeys(o[1] for outcomes in choices[node].values() for o in outcomes)
        goals |= {there for there in ahead if there[0] in model.goals}
        order += [there for there in ahead if there not in goals and there not in seen]
        seen.update(ahead)
    product = plain_model(choices, goals)
    found = []
    for policy in policies(product, begin, lambda n: list(product.choices[n])):
        moves = moves_of(product, policy)
        weight = goal_weight(product, moves, gamma)
        cost = solve_chain(
            moves,
            reaching(moves, product.goals),
            lambda o: o[1][1] if o[1] in product.goals else 0.0,
            gamma,
        )
        found.append(Point(1.0 - mean(begin, weight), mean(begin, cost)))
    return found
