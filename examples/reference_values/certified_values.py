r"""Certified reference values: an interval and a certificate file for each problem.

Solves the least cost (`MCMP`), the cost given success (`S3P`) and the tail mean (`CVaR`) of
published models at several failure budgets, and writes `values.csv` with a certificate file for
each row:

    python examples/reference_values/certified_values.py
    python examples/reference_values/certified_values.py --models qcomp_cdrive.2 --budgets 0.3 0.5
    python examples/reference_values/certified_values.py --file wlan.jani --goal done --cost time

Without `--file` these are the models of `tests/data`; with it, any file that the library reads. A
budget is a number, or `least` for the least failure. Giving up is free and allowed everywhere, and
the failing step is not charged, as in model checkers (`give_up="anywhere"`,
`charge_failing_step=False`).

Each interval is read back from its certificate file, whose exact inequalities
`certificate_lines.py` checks without this library. Tail means have no file; `certify` recomputes
their interval in floating point.
"""

import csv
import math
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from fractions import Fraction
from pathlib import Path

import ssp_lp
from examples.reference_values.published import NAMES, PUBLISHED, expected, published, raw_case
from ssp_lp import MCMP, S3P, SSP, CVaR, InfeasibleError, Solution, SSPError
from ssp_lp.io import read_any

Start = Hashable | Mapping[Hashable, float]
LEAST = "least"  # the budget of least failure
_LEVEL = 0.9  # of the tail mean: the mean of the worst tenth


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
    certificate: str = ""  # name of the file
    note: str = ""  # why there is no value, or no file


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
    model: SSP, start: Start, budgets: Sequence[str]
) -> Iterator[tuple[str, str, MCMP | S3P | CVaR]]:
    """Yield the problems of a model, each with its criterion and budget in words."""
    for text in budgets:
        budget = None if text == LEAST else float(text)
        yield "MCMP", text, MCMP(model, start, budget, **PUBLISHED)
        yield "S3P", text, S3P(model, start, budget)
        if budget is not None:
            yield f"CVaR {_LEVEL}", text, CVaR(model, start, _LEVEL, budget)


def answered(row: Row, problem: MCMP | S3P | CVaR, options: Namespace) -> Row:
    """Solve a problem, write its certificate, and return the row with the proved interval."""
    try:
        solution = ssp_lp.solve(problem, time_limit=options.time_limit)
        return _proved(row, solution, options.output)
    except InfeasibleError as error:
        return Row(*_key(row), note=f"infeasible: {error}")
    except SSPError as error:
        return Row(*_key(row), note=f"{type(error).__name__}: {error}")


def _proved(row: Row, solution: Solution, folder: Path) -> Row:
    """Return a solution's row, by its certificate file, or by `certify` if there is none."""
    failure = repr(solution.failure_probability)
    if row.criterion.startswith("CVaR"):
        found = ssp_lp.certify(solution)
        note = "no file: proved in memory" if found.accepted else f"not proved: {found.reason}"
        sides = repr(found.lower_bound), repr(found.objective)
        return Row(*_key(row), *sides, failure, note=note)
    name = f"{row.model}-{row.cost}-{row.criterion}-{row.budget}.cert"
    ssp_lp.write_certificate(solution, folder / name)
    checked = ssp_lp.check_certificate(folder / name, problem=solution.problem)
    if not checked.accepted:
        return Row(*_key(row), note=f"refused: {checked.reason}")
    lower, upper = _rounded(checked.lower, -math.inf), _rounded(checked.upper, math.inf)
    return Row(*_key(row), lower, upper, failure, checked.digest, name)


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
            for criterion, budget, problem in questions(model, start, options.budgets):
                row = answered(Row(name, cost, criterion, budget), problem, options)
                rows.append(row)
                table.writerow(asdict(row))
                told = f"{row.lower} to {row.upper}" if row.lower else row.note
                print(f"{name:<28} {cost:<10} {criterion:<9} {budget:<6} {told}", flush=True)
    proved = sum(bool(row.certificate) for row in rows)
    print(f"{len(rows)} questions, {proved} with a certificate file: {options.output}")
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
