"""Convex objectives: a fleet with congestion, and a robot that is rewarded for random actions.

Quadratic: three roads lead from the depot, and the cost of each increases with the share of the
fleet on it. At the optimum the marginal cost, with failure at its price, is equal on all roads.

Entropy: a robot crosses a field where it may disappear, and each step earns the entropy of its
action's distribution. The optimum is that of soft value iteration at the price of failure, v(s) =
-T log sum_a exp(-(cost + price * failure + E v) / T), and its policy draws with these weights.

    python examples/formulating/convex_objectives.py
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

import cvxpy as cp
import numpy as np

from examples.domains.navigation import navigation
from ssp_lp import MCMP, SSP
from ssp_lp.programs.occupation_measure import OccupationMeasure

ROADS = {"alley": (4.0, 0.10), "street": (6.0, 0.04), "bypass": (9.0, 0.01)}
"""Cost of a lorry on an empty road, and its probability of a wreck."""

CONGESTION = 4.0  # additional cost if the whole fleet takes one road
LOST_LORRIES, LOST_ROBOTS = 0.045, 0.25
TEMPERATURE = 0.4  # worth of a nat of entropy


def fleet() -> tuple[OccupationMeasure, dict[str, float]]:
    """Return the fleet's optimum, and each road's share by equal marginal costs."""
    depot = {
        road: [(1.0 - risk, "home", cost), (risk, "wreck", cost)]
        for road, (cost, risk) in ROADS.items()
    }
    model = SSP.from_transitions(
        {"depot": depot, "wreck": {}}, goal={"home"}, treat_actionless_as_dead_ends=True
    )
    convex = MCMP(model, "depot", failure_budget=LOST_LORRIES).program().to_cvxpy()
    shares = cp.hstack([convex.visits("depot", road) for road in ROADS])
    convex.objective = convex.objective + CONGESTION * cp.sum_squares(shares)
    measure = convex.solve(cp.CLARABEL)
    price = measure.duals["failure"]
    alone = {road: cost + price * risk for road, (cost, risk) in ROADS.items()}
    marginal = (sum(alone.values()) + 2.0 * CONGESTION) / len(ROADS)
    return measure, {road: (marginal - dear) / (2.0 * CONGESTION) for road, dear in alone.items()}


def robot() -> tuple[OccupationMeasure, float]:
    """Return the optimum of cost minus entropy, and its value by soft value iteration."""
    model, start = navigation(4, 4)
    problem = MCMP(model, start, failure_budget=LOST_ROBOTS, give_up="dead_ends")
    program = problem.program()
    convex = program.to_cvxpy()
    acting = [s for s in model.states if program.columns(s)]
    for state in acting:
        drawn = convex.x[list(program.columns(state))]
        total = cp.sum(drawn) * np.ones(drawn.size)
        convex.objective = convex.objective + TEMPERATURE * cp.sum(cp.rel_entr(drawn, total))
    measure = convex.solve(cp.CLARABEL)
    price = measure.duals["failure"]
    value = soft_values(model, price)[model.index_of(start)]
    return measure, float(value - price * LOST_ROBOTS)


def soft_values(model: SSP, price: float) -> np.ndarray:
    """Compute each state's least cost minus entropy, with failure at its price, [states]."""
    failed = ~model.goal_mask & ~np.isin(np.arange(model.n_states), model.pair_state)
    ends, rows = np.where(failed, price, 0.0), model.outcome_offsets[:-1]
    values, before = ends, np.full(model.n_states, np.inf)
    while np.abs(values - before).max() > 1e-13:
        before = values
        paid = np.add.reduceat(model.probabilities * (model.costs + values[model.successors]), rows)
        weights = np.bincount(model.pair_state, np.exp(-paid / TEMPERATURE), model.n_states)
        acts = weights > 0.0
        values = np.where(acts, -TEMPERATURE * np.log(weights, where=acts, out=0.0 * ends), ends)
    return values


def main() -> None:
    """Print both optima and their values in theory."""
    measure, theory = fleet()
    print(f"fleet: cost {measure.objective:.5f}, with congestion {measure.minimised:.5f},"
          f" a failure is worth {measure.duals['failure']:.3f}")  # fmt: skip
    for road, share in theory.items():
        taken = measure.program.visits("depot", road) @ measure.visits
        print(f"  {road:>7} {taken:.6f}   by equal marginal costs {share:.6f}")
    measure, value = robot()
    print(f"robot: {measure.objective:.5f} steps, less entropy {measure.minimised:.6f},"
          f" by soft value iteration {value:.6f}")  # fmt: skip
    print(f"  failure {measure.activity['failure']:.5f} at {measure.duals['failure']:.4f} each")


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    main()
