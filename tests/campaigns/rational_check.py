"""The library against exact fractions on random small models.

    python tests/campaigns/rational_check.py --count 1000 --seed 0 --family loops

Every policy of a model is enumerated and evaluated in fractions; the best lottery over them is the
reference. Prints whatever disagrees, with the model, and a table. The families: `loops` that are
left with probability 1e-3 to 1e-12 a step, and `ordinary` models.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

from ssp_lp import SSP, InfeasibleError, certify, solve
from ssp_lp.arrays import LEAST_BUDGET
from tests.campaigns.campaign import smaller_tables, smallest
from tests.campaigns.rational.criteria import questions
from tests.campaigns.rational.models import GOAL, START, Model, draw_model
from tests.campaigns.rational.policies import Exact
from tests.campaigns.rational.question import Question

SMALLEST = 1e-3  # values below are compared absolutely, by this share of the tolerance
LARGEST_GAP = 1e-8
SLOW = 20.0  # seconds
COLUMNS = ("checked", "wrong", "refused", "slow", "wide gaps", "near ties")
QUIET = ("wide gaps", "near ties")  # said by the library, or too near to tell apart
REFUSALS = ("error", "refused", "gap")


@dataclass
class Tally:
    """What was found, by criterion and kind."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    worst: float = 0.0  # seconds

    def table(self) -> str:
        """One row for each criterion."""
        names = sorted({criterion for criterion, _ in self.counts})
        rows = [("criterion", *COLUMNS)]
        rows += [(name, *(str(self.counts[name, kind]) for kind in COLUMNS)) for name in names]
        return "\n".join(
            f"{row[0]:<24}" + "".join(f"{cell:>11}" for cell in row[1:]) for row in rows
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Check models from the command line; 1 if anything was found."""
    options = _parse(arguments)
    tally, began, models = Tally(), time.perf_counter(), 0
    wanted = range(options.count) if options.only is None else [options.only]
    for index in wanted:
        if options.time_limit is not None and time.perf_counter() - began > options.time_limit:
            break
        check_model(options.family, options.seed, index, tally)
        models += 1
    print(f"\n{options.family}, seed {options.seed}: {models} models\n{tally.table()}")
    print(f"slowest answer {tally.worst:.2f} s, all {time.perf_counter() - began:.0f} s")
    return int(any(tally.counts[key] for key in tally.counts if key[1] in COLUMNS[1:4]))


def check_model(family: str, seed: int, index: int, tally: Tally) -> None:
    """Put all questions about one model and print what disagrees."""
    model = draw_model(family, seed, index)
    given = model.transitions()
    library = SSP.from_transitions(given, goal={GOAL}, treat_actionless_as_dead_ends=True)
    shown = False
    for question in questions(Exact(model)):
        tally.counts[question.criterion, "checked"] += 1
        began = time.perf_counter()
        found = list(complaints(question, library))
        seconds = time.perf_counter() - began
        tally.worst = max(tally.worst, seconds)
        if seconds > SLOW:
            found.append(("slow", f"{seconds:.1f} s"))
        for kind, text in found:
            column = "refused" if kind in REFUSALS else kind if kind in COLUMNS else "wrong"
            tally.counts[question.criterion, column] += 1
            if column in QUIET:
                continue
            print(f"seed {seed} index {index} {question.criterion}: {kind}: {text}")
            print(f"    {question.asked}")
            if not shown:
                print(f"    {given}")
                print(f"    the smallest: {shrunk(model, question.criterion).transitions()}")
            shown = True
            sys.stdout.flush()


def shrunk(model: Model, criterion: str) -> Model:
    """The smallest model on which some answer to a criterion is wrong."""

    def fails(case: Model) -> bool:
        library = SSP.from_transitions(
            case.transitions(), goal={GOAL}, treat_actionless_as_dead_ends=True
        )
        return any(
            kind not in QUIET
            for question in questions(Exact(case))
            if question.criterion == criterion
            for kind, _ in complaints(question, library)
        )

    def smaller(case: Model) -> Iterator[Model]:
        for rows in smaller_tables(case.rows, kept=[START]):
            yield replace(case, rows=rows)

    return smallest(model, smaller, fails)


def complaints(question: Question, library: SSP) -> Iterator[tuple[str, str]]:
    """What is wrong with the library's answer: kind and words."""
    answer = question.answer
    try:
        solution = solve(question.problem(library))
        certificate = certify(solution)
        reached, failed = solution.goal_probability, solution.failure_probability
    except InfeasibleError as error:
        if answer is not None:
            yield "infeasible", f"{error}; reference {float(answer)!r}"
        return
    except Exception as error:  # whatever it is, it is reported
        yield "error", f"{type(error).__name__}: {error}"
        return
    if answer is None:
        budget = question.budget
        equal = budget is not None and certificate.accepted and failed <= budget + LEAST_BUDGET
        kind = "near ties" if equal else "feasible"
        yield kind, f"objective {solution.objective!r} where there is none"
        return
    wide = bool(solution.note) and solution.lower_bound <= answer <= solution.objective
    for kind, text in _objective(question, answer, solution.objective):
        yield "wide gaps" if wide else kind, text
    if not (0.0 <= reached <= 1.0 and 0.0 <= failed <= 1.0):
        yield "probability", f"goal {reached!r}, failure {failed!r}"
    yield from _failure(question, failed)
    yield from _bounds(question, answer, solution, certificate)


def _objective(question: Question, answer: Fraction, objective: float) -> Iterator[tuple[str, str]]:
    """The objective against the reference."""
    room = question.tolerance * max(SMALLEST, abs(float(answer)))
    if not abs(objective) < float("inf"):
        yield "objective", f"{objective!r}, reference {float(answer)!r}"
        return
    if abs(Fraction(objective) - answer) <= room:
        return
    low, high = (answer, answer) if question.equals is None else question.equals()
    if low - Fraction(room) <= Fraction(objective) <= high + Fraction(room):
        return
    if question.near_tie is not None and question.near_tie - room <= objective <= answer:
        yield "near ties", ""
        return
    off = float((Fraction(objective) - answer) / max(abs(answer), Fraction(SMALLEST)))
    yield "objective", f"{objective!r}, reference {float(answer)!r} (off by {off:.2g})"


def _failure(question: Question, failed: float) -> Iterator[tuple[str, str]]:
    """The failure against the least one, or the budget."""
    if question.least is not None and failed > float(question.least) * (1 + 1e-9) + 1e-11:
        yield "failure", f"{failed!r}, least {float(question.least)!r}"
    if question.budget is not None and failed > question.budget * (1 + 1e-9) + 1e-15:
        yield "budget", f"failure {failed!r} above {question.budget!r}"


def _bounds(
    question: Question, answer: Fraction, solution: Any, certificate: Any
) -> Iterator[tuple[str, str]]:
    """The certificate, and the bounds of both."""
    if not certificate.accepted:
        yield "refused", certificate.reason
    exact = float(answer)
    low = exact if question.equals is None else float(question.equals()[1])
    for name, found in (("solution", solution), ("certificate", certificate)):
        if name == "certificate" and not certificate.accepted:
            continue
        if found.upper_bound is not None:
            if found.upper_bound < exact * (1 - 1e-12):
                yield "upper bound", f"{name}: {found.upper_bound!r}, reference {exact!r}"
        elif found.lower_bound > low * (1 + question.tolerance) + 1e-12:
            yield "lower bound", f"{name}: {found.lower_bound!r}, reference {exact!r}"
        if found.gap > LARGEST_GAP and not solution.note:
            yield "gap" if name == "solution" else "wide gaps", f"{name}: {found.gap:.2g}"


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000, help="number of models")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--family", choices=("loops", "ordinary"), default="loops")
    parser.add_argument("--only", type=int, default=None, help="the number of one model")
    parser.add_argument("--time-limit", type=float, default=None, help="seconds in all")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
