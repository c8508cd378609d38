"""The best single policy, for a controller that may not toss a coin.

The best lottery attains c*; one deterministic policy that keeps to the budget may have to cost
more. It is found by a mixed-integer program over the states of the process (case S: state and
accumulated cost): x counts expected visits, a binary y per pair says which is taken,

    x_pair <= V_state * y_pair,   sum over the pairs of a state of y = 1.

**The bound V on visits** is the greatest expected number of visits of the state over all policies,
randomised ones included, that keep to the budget and cost no more than the best policy known
beforehand: a linear program for each state (one for all states together where there are many), 1
where no state can be visited twice. No better policy is lost by it. It is finite because what
costs nothing and could go on for ever is collapsed in the process. Under a discount it cannot
exceed 1 / (1 - discount). V is an optimum over all policies with a margin for rounding, so that an
answer whose visits come up to it needs no second try with a larger one.

The ratio of case S is minimised by Dinkelbach's iteration. Every policy is read off y and measured
exactly on the process; one that keeps to the budget only within HiGHS's tolerances is refused and
excluded by a further row. The lower bound is the better of HiGHS's dual bound, lowered by 1e-9 of
itself, and the lottery's; the former carries HiGHS's tolerances and is not a checked sub-solution.

Policies that leave a collapsed component by a way that depends on where it was entered, or go on
beyond the cap of case S otherwise than by the tails, are counted in the bound but not searched: a
gap may then remain that is not due to the time limit. Policies with more memory than the state of
the process, which could take coins from chance itself, are not counted at all where the bound is
HiGHS's.
"""

from __future__ import annotations

from dataclasses import replace

from ssp_lp.column_generation.failure_row import relative_gap
from ssp_lp.methods.integer_programming.search import best_single_policy
from ssp_lp.methods.refinement import RefinedOutcome
from ssp_lp.policies.mixed import as_lottery
from ssp_lp.solution import Solution

_OPEN = 1e-6  # relative gap from which determinism is said to cost at most so much


def best_deterministic(
    mixed: Solution, outcome: RefinedOutcome, tolerance: float, deadline: float
) -> Solution:
    """The best single deterministic policy, beside the best lottery.

    Args:
        mixed: the best lottery; its price of failure and its value function are kept.
        outcome: of the search that found it.
        tolerance: relative gap at which to stop.
        deadline: on the clock of ``time.perf_counter``.

    Raises:
        ModelError: the formulation is not supported, or its process is too large.
    """
    single, finished = best_single_policy(outcome, tolerance, deadline)
    gap = relative_gap(single.value, single.bound)
    is_open = gap > _OPEN
    cost = f"{'at most ' if is_open else ''}{max(single.value - mixed.objective, 0.0):.9g}"
    remarks = [
        f"deterministic: the mixed optimum is {mixed.objective:.9g}, determinism costs {cost}"
    ]
    if mixed.note:
        remarks.append(mixed.note)
    if not finished and "stopped" not in mixed.note:
        remarks.append("stopped before the search was finished; the gap is honest")
    if finished and gap > max(_OPEN, 2.0 * tolerance):
        remarks.append("the gap is what policies outside the search could gain at most")
    return replace(
        mixed,
        policy=as_lottery(single.policy),
        objective=single.value,
        lower_bound=min(single.bound, single.value),
        budget_used=single.failure,
        note="; ".join(remarks),
    )
