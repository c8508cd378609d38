"""Case S for costs without a common unit: all possible sums of costs, or multiples of a unit.

A windy field is crossed with a diagonal step of 1.4, 1.41 or sqrt(2), or with costs drawn between
0.5 and 2. If the possible sums of costs are few, all of them are distinguished, and the answer is
exact. If they are too many, every cost is split between two multiples of a unit, and the answer
lies between two bounds, whose distance falls with the unit.

    python examples/formulating/real_costs.py --sizes 12 24 --time-limit 10

Takes half a minute; `--sizes 12 24 48` some two minutes.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence
from random import Random
from time import perf_counter

from examples.domains.domain import Domain
from examples.domains.windy_field import windy_field
from ssp_lp import S3P, CostAwarePolicy, Solution, SSPError, solve

BUDGET = 0.3
LEVELS = (100, 200, 400, 800, 1600, 3200)
LAWS: dict[str, dict[str, float] | int] = {
    "1.4": {"diagonal": 1.4},
    "1.41": {"diagonal": 1.41},
    "sqrt(2)": {"diagonal": 2**0.5},
    "3 costs": 3,
    "10 costs": 10,
    "1000 costs": 1000,
}
"""Cost of a diagonal step, or number of costs that are drawn."""


def field(size: int, law: str) -> Domain:
    """Return the field with costs of a given kind."""
    how = LAWS[law]
    if isinstance(how, int):
        rng = Random(5)
        return windy_field(size, prices=[rng.uniform(0.5, 2.0) for _ in range(how)])
    return windy_field(size, diagonal=how["diagonal"])


def told_apart(solution: Solution) -> int:
    """Return the greatest number of totals that a solution's policies distinguish."""
    members = solution.policy.policies
    return max((p.cap for p in members if isinstance(p, CostAwarePolicy)), default=0)


def report(sizes: Sequence[int], time_limit: float) -> None:
    """Print a line for each size and kind of costs."""
    print(f"S3P, failure budget {BUDGET}, at most {time_limit:g} s")
    print(f"{'size':>4} {'costs':>12} {'outcomes':>9} {'objective':>12} {'levels':>7}"
          f" {'gap':>8} {'seconds':>8}")  # fmt: skip
    for size in sizes:
        for law in LAWS:
            model, start = field(size, law)
            began = perf_counter()
            try:
                found = solve(S3P(model, start, BUDGET), time_limit=time_limit)
            except SSPError as error:
                print(f"{size:4} {law:>12} {model.n_outcomes:9,} {type(error).__name__}")
                continue
            seconds = perf_counter() - began
            print(f"{size:4} {law:>12} {model.n_outcomes:9,} {found.objective:12.8f}"
                  f" {told_apart(found):7,} {found.gap:8.1e} {seconds:8.2f}")  # fmt: skip


def report_levels(size: int) -> None:
    """Print the gap for a thousand costs by the number of levels."""
    model, start = field(size, "1000 costs")
    print(f"\nsize {size}, 1000 costs: the gap by the number of cost levels")
    print(f"{'levels':>7} {'lower bound':>12} {'objective':>12} {'gap':>8} {'seconds':>8}")
    for levels in LEVELS:
        began = perf_counter()
        found = solve(S3P(model, start, BUDGET, cost_levels=levels))
        seconds = perf_counter() - began
        print(f"{levels:7,} {found.lower_bound:12.8f} {found.objective:12.8f} {found.gap:8.1e}"
              f" {seconds:8.2f}")  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[12, 24], help="of the field")
    parser.add_argument("--time-limit", type=float, default=10.0, help="seconds of each solve")
    asked = parser.parse_args(argv)
    solve(S3P(*field(4, "sqrt(2)"), BUDGET))  # loads what is compiled
    report(asked.sizes, asked.time_limit)
    report_levels(min(asked.sizes))


if __name__ == "__main__":
    main()
