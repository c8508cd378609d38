"""This library's methods in the comparison."""

import math
import time
from contextlib import suppress

from examples.solver_comparison.instances.instance import parse_instance
from examples.solver_comparison.instances.models import ReadyInstance, build
from examples.solver_comparison.solvers.answer import Answer, Prepared, infeasible, joined
from examples.solver_comparison.solvers.catalogue import Order
from ssp_lp import InfeasibleError, LinearProgramming, Solution, SolverError, solve
from ssp_lp.compiled.accelerator import has_accelerator


def prepare(ready: ReadyInstance, order: Order, *, method: str, backend: str | None) -> Prepared:
    """Prepare to solve an instance with a method.

    If numba is installed, the first call compiles inner loops. So a small instance is first solved
    by column generation, with which the other methods end.
    """
    failure_budget = ready.instance.failure_budget

    def call() -> Answer:
        began = time.perf_counter()
        try:
            solution = solve(
                ready.problem(),
                LinearProgramming(backend) if method == "lp" else method,
                tolerance=order.tolerance,
                time_limit=order.time_limit,
            )
        except InfeasibleError:
            return infeasible(ready.instance.case)
        except SolverError as error:
            if time.perf_counter() - began < order.time_limit:
                raise
            return Answer(math.nan, details=str(error), in_time=False)
        return _answer(solution, order, failure_budget)

    small = ready if ready.instance.warm_up == ready.instance else None

    def warm_up() -> None:
        problem = (small or build(ready.instance.warm_up)).problem()
        if small is None and has_accelerator():  # the loops of large models, on a small one
            from ssp_lp.compiled.cores import on_all_cores

            with on_all_cores(), suppress(InfeasibleError):
                solve(problem, "columns")
        with suppress(InfeasibleError):
            solve(problem, "columns")

    return Prepared(call, warm_up)


def _answer(solution: Solution, order: Order, failure_budget: float) -> Answer:
    run, has_no_budget = solution.run, parse_instance(order.instance).case in "PC"
    loops = "numba" if has_accelerator() else "numpy"
    return Answer(
        objective=solution.objective,
        gap=solution.gap,
        note=joined(f"{run.pricing_calls} pricing calls", loops, solution.note),
        details=run.program,
        in_time=solution.gap <= order.tolerance or run.seconds < order.time_limit,
        backups=run.work.backups,
        products=run.work.products,
        excess=None if has_no_budget else lambda: max(solution.budget_used - failure_budget, 0.0),
    )
