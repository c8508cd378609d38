r"""Certified reference values: an interval and a certificate file for each problem.

Solves the least cost (`MCMP`), the cost given success (`S3P`) and the tail mean (`CVaR`) of
published models at several failure budgets, and writes `values.csv` with a certificate file for
each row:

    python examples/reference_values/certified_values.py
    python examples/reference_values/certified_values.py --models qcomp_cdrive.2 --budgets 0.3 0.5
    python examples/reference_values/certified_values.py --file wlan.jani --goal done --cost time

Without `--file` these are the models of `tests/data`; with it, any file that the library reads. A
budget is a number, `least` for the least failure, or `turning` for the failure probabilities at
which the frontiers of `MCMP` and `S3P` turn (`turning_points`). In `MCMP`, giving up is free and
allowed everywhere, and the failing step is not charged, as in model checkers
(`give_up="anywhere"`, `charge_failing_step=False`).

Each interval is read back from its certificate files, whose exact inequalities
`certificate_lines.py` checks without this library. A tail mean has a folder with one file for each
threshold z, in which the cost beyond z is proved (`proved_tail_mean` says why these suffice).
"""

import csv
import math
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from fractions import Fraction
from functools import reduce
from pathlib import Path

import numpy as np

import ssp_lp
from examples.reference_values.published import NAMES, PUBLISHED, expected, published, raw_case
from ssp_lp import MCMP, S3P, SSP, CVaR, InfeasibleError, Solution, SSPError, arrival_cost
from ssp_lp.formulation import Formulation, Quantity
from ssp_lp.io import read_any

Start = Hashable | Mapping[Hashable, float]
LEAST, TURNING = "least", "turning"  # budgets: the least failure, the frontier's turning points
_LEVEL = 0.9  # of the tail mean: the mean of the worst tenth
_TURNS = 20  # greatest number of turning points of a frontier


@dataclass(frozen=True)
class Row:
    """One problem and its proved interval, in words and decimals."""

    model: str
    cost: str
    criterion: str
    budget: str
    lower: str = ""  # the optimum lies between these
    upper: str = ""
    failure: str = ""  # of the lottery that attains the upper one
    sha256: str = ""  # of the question and the model, as the certificate states them
    certificate: str = ""  # name of the file, or of the folder of a tail mean
    note: str = ""  # why there is no value


@dataclass(frozen=True, eq=False)
class Excess(Formulation):
    """The least mean cost beyond a threshold, given success."""

    model: SSP
    start: Start
    threshold: float
    failure_budget: float | None = None
    ratio = True

    @property
    def quantity(self) -> Quantity:
        """Return the cost of a run beyond the threshold."""
        begin = self.threshold
        return arrival_cost(lambda cost: np.maximum(cost - begin, 0.0), affine_from=begin)


def named_models(options: Namespace) -> Iterator[tuple[str, str, SSP, Start]]:
    """Yield each requested model: its name, the name of its cost, the model and its start."""
    if options.file is not None:
        model, start = read_any(options.file, options.goal or (), options.cost)
        yield options.file.stem, options.cost or "cost", model, start
        return
    costs: dict[str, list[str]] = {name: [] for name in NAMES if raw_case(name)["goal"]}
    for case in expected()["cases"]:
        listed = costs.get(case["model"], [])
        if case["cost"] not in listed:
            listed.append(case["cost"])
    for name in options.models or costs:
        for cost in costs[name] or ["unit"]:
            yield name, cost, *published(name, cost)


def questions(
    model: SSP, start: Start, budgets: Sequence[str], time_limit: float
) -> Iterator[tuple[str, str, MCMP | S3P | CVaR]]:
    """Yield the problems of a model, each with its criterion and budget in words."""
    cheapest, given_success = MCMP(model, start, **PUBLISHED), S3P(model, start)
    for text in budgets:
        if text == TURNING:
            for problem in (cheapest, given_success):
                for budget in turning_points(problem, time_limit):
                    name = type(problem).__name__
                    yield name, repr(budget), replace(problem, failure_budget=budget)
            continue
        budget = None if text == LEAST else float(text)
        yield "MCMP", text, replace(cheapest, failure_budget=budget)
        yield "S3P", text, replace(given_success, failure_budget=budget)
        yield f"CVaR-{_LEVEL}", text, CVaR(model, start, _LEVEL, budget)


def turning_points(problem: MCMP | S3P, time_limit: float) -> list[float]:
    """Return the failure probabilities at which a frontier turns, rounded up to nine digits.

    Certificates at these budgets prove the frontier. A lottery over the policies of two neighbours
    attains every budget between them. In case M the price in each file bounds the cost at all
    other budgets.
    """
    frontier = ssp_lp.trace_frontier(problem, time_limit=time_limit, point_limit=_TURNS)
    return [math.ceil(budget * 1e9) / 1e9 for budget in frontier.failure.tolist()]


def answered(row: Row, problem: MCMP | S3P | CVaR, options: Namespace) -> Row:
    """Solve a problem, write its certificate, and return the row with the proved interval."""
    try:
        solution = ssp_lp.solve(problem, time_limit=options.time_limit)
        return _proved(row, solution, options.output, options.time_limit)
    except InfeasibleError as error:
        return Row(*_key(row), note=f"infeasible: {error}")
    except SSPError as error:
        return Row(*_key(row), note=f"{type(error).__name__}: {error}")


def _proved(row: Row, solution: Solution, folder: Path, time_limit: float) -> Row:
    """Return a solution's row with its interval, read back from its certificate files."""
    name = f"{row.model}-{row.cost}-{row.criterion}-{row.budget}"
    if isinstance(solution.problem, CVaR):
        (folder / name).mkdir(exist_ok=True)
        digest, *sides = proved_tail_mean(solution.problem, solution, folder / name, time_limit)
    else:
        name += ".cert"
        digest, *sides = _written(solution, folder / name)
    lower, upper = _rounded(sides[0], -math.inf), _rounded(sides[1], math.inf)
    return Row(*_key(row), lower, upper, repr(solution.failure_probability), digest, name)


def _written(solution: Solution, path: Path) -> tuple[str, Fraction, Fraction]:
    """Write a certificate, check it, and return its SHA-256 and the interval of the optimum."""
    ssp_lp.write_certificate(solution, path)
    checked = ssp_lp.check_certificate(path, problem=solution.problem)
    if not checked.accepted:
        raise SSPError(f"refused: {checked.reason}")
    return checked.digest, checked.lower, checked.upper


def proved_tail_mean(
    problem: CVaR, solution: Solution, folder: Path, time_limit: float
) -> tuple[str, Fraction, Fraction]:
    """Prove a tail mean by certificates of the cost beyond thresholds, one file for each.

    The tail mean is the least value of v(z) = z + E[(C - z)^+ | goal] / (1 - level) over policies
    and thresholds z. For every policy v(z) is linear between two possible totals, so that the
    totals suffice as thresholds. A proof for one of them bounds the others: the slope of v(z) is
    at most 1 and at least -level / (1 - level). Since v(z) >= z, thresholds above the upper bound
    need no proof. Thresholds are proved in the order of their bounds, the least first, until the
    least bound is a proved one.

    Returns:
        SHA-256 of the file whose policy has the upper bound, and the interval of the tail mean.

    Raises:
        SSPError: a certificate is refused, or a total is not a decimal (costs of 1/3).
    """
    tail, unit = 1 - Fraction(str(problem.level)), _unit_of(problem.model)
    last = math.floor(Fraction(solution.objective) / unit) + 1
    bounds = {unit * k: unit * k for k in range(last + 1)}
    quantile = ssp_lp.success_costs(solution.policy, problem).quantile(problem.level)
    threshold = max(z for z in bounds if z <= quantile)
    proved: dict[Fraction, tuple[str, Fraction, Fraction]] = {}
    while threshold not in proved:
        excess = Excess(problem.model, problem.start, float(threshold), problem.failure_budget)
        if Fraction(repr(excess.threshold)) != threshold:
            raise SSPError(f"no file can state the threshold {threshold}, which is not a decimal")
        found = ssp_lp.solve(excess, time_limit=time_limit)
        digest, *sides = _written(found, folder / f"{float(threshold)!r}.cert")
        lower, upper = (threshold + side / tail for side in sides)
        proved[threshold] = digest, lower, upper
        for z in bounds:
            slope = 1 if z < threshold else (1 - tail) / tail
            bounds[z] = max(bounds[z], lower - slope * abs(z - threshold))
        least = min(bounds, key=bounds.__getitem__)
        if bounds[least] < min(upper for *_, upper in proved.values()):
            threshold = least
    digest, _, upper = min(proved.values(), key=lambda file: file[2])
    return digest, min(bounds.values()), upper


def _unit_of(model: SSP) -> Fraction:
    """Return the greatest number of which every cost is a multiple, as decimals; 1 for no cost."""
    exact = model.exact_costs
    paid = [cost for cost in np.unique(model.costs).tolist() if cost]
    costs = [exact.get(cost, Fraction(repr(cost))) for cost in paid]
    scale = math.lcm(*(cost.denominator for cost in costs))
    return Fraction(reduce(math.gcd, (int(cost * scale) for cost in costs), 0) or scale, scale)


def _rounded(bound: Fraction, outwards: float) -> str:
    """Return an end of a proved interval as a float's decimal, rounded outwards."""
    near = float(bound)
    is_inside = near > bound if outwards < 0.0 else near < bound
    return repr(math.nextafter(near, outwards) if is_inside else near)


def _key(row: Row) -> tuple[str, str, str, str]:
    return row.model, row.cost, row.criterion, row.budget


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    """Solve all problems; print and save a line for each, and return the rows."""
    options = _parse(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    with (options.output / "values.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, [field.name for field in fields(Row)])
        table.writeheader()
        for name, cost, model, start in named_models(options):
            asked = questions(model, start, options.budgets, options.time_limit)
            for criterion, budget, problem in asked:
                row = answered(Row(name, cost, criterion, budget), problem, options)
                rows.append(row)
                table.writerow(asdict(row))
                told = f"{row.lower} to {row.upper}" if row.lower else row.note
                print(f"{name:<28} {cost:<10} {criterion:<9} {budget:<6} {told}", flush=True)
    proved = sum(bool(row.certificate) for row in rows)
    print(f"{len(rows)} questions, {proved} with certificates: {options.output}")
    return rows


def _parse(arguments: Sequence[str] | None) -> Namespace:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--models", nargs="+", choices=NAMES, metavar="NAME", help="of tests/data; default: all")
    add("--file", type=Path, help="a model of your own, in any format that the library reads")
    add("--goal", nargs="+", help="of the file: its goal states, or a label of them")
    add("--cost", help="of the file: the cost that counts")
    default = [LEAST, "0.01", "0.05", "0.1", "0.2", "0.5"]
    add("--budgets", nargs="+", default=default, help=f"default: {' '.join(default)}")
    add("--time-limit", type=float, default=60.0, help="seconds for one question; default: 60")
    add("--output", type=Path, default=Path("reference_values"), help="folder")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main(sys.argv[1:])
