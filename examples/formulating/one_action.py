"""One action in each state: deterministic policies of the state, as a mixed-integer program.

Within a failure budget a lottery is cheapest. A deterministic policy needs a binary variable for
each action of each state, exactly one of which is 1: this is harder to solve, and costs more. A
river is crossed by its bridge or, for a part of the way, by swimming. `solve(problem,
DeterministicPolicies())` is the library's own method for these policies, with a proof.

    python examples/formulating/one_action.py
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from dataclasses import replace

import cvxpy as cp

from examples.domains.river import river
from ssp_lp import MCMP, evaluate, solve
from ssp_lp.programs.occupation_measure import OccupationMeasure

BUDGETS = (0.0, 0.3, 0.4, 0.6, 0.7)
TAKEN = 1e-6  # visits: less is a solver's tolerance


def deterministic(problem: MCMP) -> tuple[OccupationMeasure, dict[object, object]]:
    """Find the optimum with one action for each state, and the actions of visited states.

    Every step costs 1, so that no action is taken more often than the safest policy takes steps.
    """
    program = problem.program()
    convex = program.to_cvxpy()
    chosen = cp.Variable(program.process.n_pairs, boolean=True)
    steps = solve(replace(problem, failure_budget=0.0)).objective
    convex.constraints["opened"] = convex.x <= steps * chosen
    for state in filter(program.columns, problem.model.states):
        convex.constraints[f"one at {state}"] = cp.sum(chosen[list(program.columns(state))]) == 1
    measure = convex.solve(cp.SCIPY, scipy_options={"mip_rel_gap": 0.0})
    columns = (program.label(k) for k, times in enumerate(measure.visits) if times > TAKEN)
    return measure, {column.state: column.action for column in columns}


def main() -> None:
    """Print both optima within each budget, and the way of the deterministic policy."""
    model, start = river(4, 3)
    print(f"{'budget':>6} {'lottery':>9} {'one action':>11} {'failure':>9}  the way")
    for budget in BUDGETS:
        problem = MCMP(model, start, failure_budget=budget, give_up="dead_ends")
        measure, way = deterministic(problem)
        found = evaluate(measure.mixed_policy(), problem)
        moves = ", ".join(f"{state} {action}" for state, action in way.items())
        print(f"{budget:6.2f} {solve(problem).objective:9.5f} {found.objective:11.5f}"
              f" {found.failure_probability:9.5f}  {moves}")  # fmt: skip


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    main()
