"""A task in PPDDL, searched from the start with the heuristic h_max as the bound of costs.

scikit-decide reads the files and computes h_max (`pip install 'scikit-decide[shared]'`):

    python examples/formulating/ppddl_file.py
    python examples/formulating/ppddl_file.py --domain DOMAIN --problem PROBLEM --budget 0.1

Without files, a car drives on roads that may burst its only spare tyre.
"""

import importlib.util
import math
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ssp_lp import MCMP, SSP, Solution, certify, solve

_NO_WAY = 1e9  # value of h_max from which the goal cannot be reached

DOMAIN = """
(define (domain tyres)
  (:requirements :typing :strips :probabilistic-effects)
  (:types place)
  (:predicates (at ?p - place) (road ?a ?b - place) (spare ?p - place) (driving))
  (:action drive :parameters (?a ?b - place)
    :precondition (and (at ?a) (road ?a ?b) (driving))
    :effect (and (at ?b) (not (at ?a)) (probabilistic 0.2 (not (driving)))))
  (:action change :parameters (?p - place)
    :precondition (and (at ?p) (spare ?p))
    :effect (and (driving) (not (spare ?p)))))
"""

PROBLEM = """
(define (problem short-or-safe)
  (:domain tyres)
  (:objects home gorge town village castle - place)
  (:init (at home) (driving) (road home gorge) (road gorge castle) (road home town)
    (road town village) (road village castle) (spare town) (spare village))
  (:goal (at castle)))
"""


def read_task(domain: Path, problem: Path) -> tuple[SSP, Any]:
    """Return the task of two PPDDL files as an implicit model, and its first state."""
    from skdecide.hub.domain.pddl import HMax, PPDDLDomain

    task = PPDDLDomain(str(domain), str(problem))
    estimate, goals, start = HMax(task.task), task.get_goals(), task.get_initial_state()

    def steps(state: Any) -> dict[str, list[tuple[float, Any, float]]]:
        """Return the outcomes of each action."""
        actions = task.get_applicable_actions(state).get_elements()
        return {str(action): list(outcomes(state, action)) for action in actions}

    def outcomes(state: Any, action: Any) -> Any:
        for after, share in task.get_next_state_distribution(state, action).get_values():
            yield share, after, task.get_transition_value(state, action, after).cost

    def least_cost(state: Any) -> float:
        """Return h_max: a lower bound of the cost of every path to the goal."""
        value = estimate(state.to_cpp())
        return value if value < _NO_WAY else math.inf

    return SSP.implicit(start, steps, goals.contains, cost_bound=least_cost), start


def explored(domain: Path, problem: Path, budget: float) -> Solution:
    """Solve within a failure budget; print the solution, the explored part and the proof."""
    model, start = read_task(domain, problem)
    solution = solve(MCMP(model, start, failure_budget=budget, give_up="dead_ends"))
    print(f"cost {solution.objective:.6g}, failure {solution.failure_probability:.6g}")
    print(f"{solution.problem.model.n_states:,} states explored; {certify(solution)}")
    return solution


def main(arguments: list[str] | None = None) -> Solution | None:
    """Solve the files given, or the drive to the castle; None without scikit-decide."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--domain", type=Path, help="a PPDDL domain")
    parser.add_argument("--problem", type=Path, help="a PPDDL problem")
    parser.add_argument("--budget", type=float, default=0.1, help="of failure; default: 0.1")
    options = parser.parse_args(arguments)
    if importlib.util.find_spec("skdecide") is None:
        print("skipped: pip install 'scikit-decide[shared]'")
        return None
    if options.domain is not None and options.problem is not None:
        return explored(options.domain, options.problem, options.budget)
    with TemporaryDirectory() as folder:
        domain, problem = Path(folder, "domain.pddl"), Path(folder, "problem.pddl")
        domain.write_text(DOMAIN, encoding="utf-8")
        problem.write_text(PROBLEM, encoding="utf-8")
        return explored(domain, problem, options.budget)


if __name__ == "__main__":
    main()
