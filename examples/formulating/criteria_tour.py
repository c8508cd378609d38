"""A tour of the criteria on the dead-end domains of the literature.

Puts every criterion on a river, a navigation field and a triangle of roads side by side, and then
shows that they are one picture, the frontier of cost against failure: alpha-MCMP walks along it,
and the finite penalty D is its tangent of slope D.

    python examples/formulating/criteria_tour.py

Takes a few seconds.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator

from examples.domains.domain import Domain
from examples.domains.navigation import navigation
from examples.domains.river import river
from examples.domains.triangle_tireworld import triangle_tireworld
from ssp_lp import (
    MCMP,
    S3P,
    AlphaMCMP,
    CriteriaComparison,
    FinitePenalty,
    Frontier,
    compare_criteria,
    solve,
    trace_frontier,
)

FRACTIONS = (0.1, 0.3, 0.5, 0.7, 0.9, 0.999)
PENALTIES = (1.0, 5.0, 20.0, 100.0, 1000.0)

Row = tuple[str, float, float]
"""Label, value by the criterion, value by the frontier."""


def tour() -> Iterator[tuple[str, Domain]]:
    """Yield the domains of the tour: a name and a model with its start."""
    yield "river, 5 x 15", river(5, 15)
    yield "navigation, 6 x 4", navigation(6, 4)
    yield "triangle tireworld, size 3", triangle_tireworld(3)


def compared(domain: Domain) -> CriteriaComparison:
    """Compare all criteria; the cost bound is the optimum of S3P with least failure."""
    model, start = domain
    typical = solve(S3P(model, start)).objective
    return compare_criteria(
        model,
        start,
        cost_bounds=(round(typical),),
        levels=(0.9,),
        exponential_utilities=((-0.1, 1.0),),
    )


def free_frontier(domain: Domain) -> Frontier:
    """Trace least cost against failure where giving up is free and allowed anywhere."""
    model, start = domain
    problem = MCMP(model, start, failure_budget=1.0, give_up="anywhere", charge_failing_step=False)
    return trace_frontier(problem)


def shares(domain: Domain, frontier: Frontier) -> list[Row]:
    """Solve alpha-MCMP at several shares, and read the frontier at the same budgets."""
    model, start = domain
    rows = []
    for share in FRACTIONS:
        problem = AlphaMCMP(model, start, share)
        by_frontier = frontier.objective_at(problem.failure_budget)
        rows.append((f"alpha = {share:g}: cost", solve(problem).objective, by_frontier))
    return rows


def tangents(domain: Domain, frontier: Frontier) -> list[Row]:
    """Solve finite penalties D, and minimise cost + D * failure over the frontier's points."""
    model, start = domain
    rows = []
    for penalty in PENALTIES:
        found = solve(FinitePenalty(model, start, penalty)).objective
        tangent = float((frontier.cost + penalty * frontier.failure).min())
        rows.append((f"D = {penalty:g}: cost + penalty", found, tangent))
    return rows


def main() -> None:
    """Print the tour."""
    for name, domain in tour():
        model = domain.model
        print(f"\n{name}: {model.n_states:,} states, {model.n_pairs:,} state-action pairs")
        print(compared(domain).summary())
        frontier = free_frontier(domain)
        print(f"\n  {'one picture':24} {'criterion':>14} {'frontier':>14}")
        for what, found, theory in shares(domain, frontier) + tangents(domain, frontier):
            print(f"  {what:24} {found:14.9f} {theory:14.9f}")


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    main()
