"""Certificates of random problems, checked; and the same files with changes, which must not lie.

    python tests/campaigns/certificate_check.py --count 1000 --seed 0 --changes 4

Problems are those of `program_check.py`: models of 2 to 30 states with loops, dead-ends and several
starts, every `give_up`, discounts, horizons, memories, up to four limits; and S3P, quantiles, the
goal within a cost and exponential utilities where costs go round in loops. Of each answer a
certificate is written and checked. Its interval must hold what `solve` said, the optimum of a
linear program that is written from the page on the format (`tests/references/stated.py`) and that
of `program_check.py`'s own, and be narrower than 1e-9.

Then the file is changed: a probability, a cost, a successor, a bound, a weight of the objective,
the discount, the horizon, the start, a set of states, where one may give up; or of the proof a
decision, a weight, a price, a value, a vector, the cap, the unit, two lines exchanged, a line left
out. What is left of it must be refused by name, or still be true: the interval then holds the
optimum of the question that the changed file states. To who asks the question that was answered at
first, a file with another question or model is refused.
"""

import argparse
import gzip
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from formulations import EGUBS, S3P, CostBoundedReach, CostQuantile
from ssp_lp import SSP, InfeasibleError, ModelError, SSPError, solve
from ssp_lp.verification.certificate_file import Checked, check_certificate, write_certificate
from tests.campaigns.campaign import run, smallest
from tests.campaigns.program_check import (
    CRITERIA,
    GOAL,
    Asked,
    Setting,
    drawn_case,
    drawn_task,
    posed,
    smaller,
)
from tests.references.combined import Task
from tests.references.stated import optimum

TOTALS: dict[str, Callable[[SSP, Task, Asked], Any]] = {
    "S3P": lambda m, t, n: S3P(m, t.start, t.most_failure),
    "CostQuantile": lambda m, t, n: CostQuantile(m, t.start, n.level, t.most_failure),
    "CostBoundedReach": lambda m, t, n: CostBoundedReach(m, t.start, n.bound, t.most_failure),
    "EGUBS": lambda m, t, n: EGUBS(m, t.start, -0.4, 0.7),
}
"""Criteria of the total cost; on models, too, in which costly steps may lead anywhere."""

MOST = 400  # states with totals in a program
WIDTH, AGREED = 1e-9, 1e-7  # of an interval; of solvers in floating point; both of 1 + |value|
ROUNDED = 1e-9  # of a share, by solvers in floating point
Lines = list[bytes]


KINDS = (*CRITERIA, *(f"{name}, looping" for name in TOTALS), "CostQuantile")
"""Problems, one kind after the other by their seeds."""

Case = tuple[Task, Setting]


def case_of(seed: int) -> Case:
    """A model and what is asked of it: as in `program_check.py`, or the total cost in loops."""
    turn, name = seed // len(KINDS), KINDS[seed % len(KINDS)]
    if name in CRITERIA:
        return drawn_case(turn * len(CRITERIA) + list(CRITERIA).index(name))
    rng = np.random.default_rng([seed, 2800])
    task = drawn_task(rng, loops=name.endswith("looping"))
    level = float(rng.choice([0.3, 0.5, 0.8, 0.95]))
    where = str(rng.choice(["anywhere", "attention", "dead_ends"]))
    asked = Asked(level, int(rng.integers(1, 12)), 0.0, where, bool(rng.integers(2)), None)
    return task, Setting(name, asked, None, False)


def question(case: Case) -> tuple[Any, Callable[[], float | None]]:
    """A problem, and its optimum by a program of its own; not a number where there is none."""
    task, setting = case
    if setting.criterion in CRITERIA:
        draw = posed(task, setting)
        return draw.problem, lambda: draw.optimum(draw.task)
    model = SSP.from_transitions(task.choices, goal=set(GOAL), treat_actionless_as_dead_ends=True)
    name = setting.criterion.removesuffix(", looping")
    return TOTALS[name](model, task, setting.asked), lambda: float("nan")


def lines_of(path: Path) -> Lines:
    """The lines of a file."""
    return gzip.decompress(path.read_bytes()).splitlines()


def holds(checked: Checked, known: float | None) -> bool:
    """Whether an interval holds an optimum, but for the rounding of the latter."""
    if known is None:
        return bool(checked.exceeded)
    if np.isnan(known):
        return True
    room = AGREED * (1.0 + abs(known))
    return float(checked.lower) - room <= known <= float(checked.upper) + room


def known_of(lines: Lines, checked: Checked) -> float | None:
    """The optimum of what a file asks, by a program; not a number where totals go on too far.

    A quantile that is exceeded with just the share that it may be is one of two totals, between
    which the rounding of a program decides: that is taken which was proved, if one of them was.
    """
    try:
        known = optimum(lines, MOST, whole=True, room=ROUNDED)
        if not holds(checked, known):
            other = optimum(lines, MOST, whole=True, room=-ROUNDED)
            known = other if holds(checked, other) else known
    except OverflowError:
        return float("nan")
    return known


def interval(checked: Checked) -> str:
    """What is proved, to be told of."""
    return f"[{float(checked.lower)!r}, {float(checked.upper)!r}]"


def moved(text: str, rng: np.random.Generator) -> str:
    """Another number, near or far."""
    value = Fraction(text)
    kind = int(rng.integers(4))
    if kind == 0:
        return str(Fraction(int(rng.integers(0, 12)), int(rng.integers(1, 6))))
    size = Fraction(1, 10 ** int(rng.choice([1, 3, 6, 9, 12, 16, 22])))
    part = int(rng.integers(1, 10)) * size * int(rng.choice([-1, 1]))
    return str(value * (1 + part) if kind < 3 and value else value + part)


def _place(rng: np.random.Generator, some: Sequence[Any]) -> Any:
    return some[int(rng.integers(len(some)))] if len(some) else None


def change_question(content: dict[str, Any], rng: np.random.Generator) -> bool:
    """Change what is asked; whether something was changed."""
    kind = int(rng.integers(10))
    if content["charge"] and rng.random() < 0.3:
        step, k = _place(rng, content["charge"]), int(rng.integers(0, 4))
        step[k] = ">=" if step[0] == ">" and k == 0 else ">" if k == 0 else moved(step[k], rng)
    elif content["quantile"] is not None and rng.random() < 0.3:
        content["quantile"] = _place(rng, ["0.2", "0.5", "0.9", "0.99"])
    elif kind == 9:
        content["horizon"] = _place(rng, [None, 1, 2, 3, 6])
    elif kind == 8:
        content["discount"] = _place(rng, [None, "0.9", "99/100"])
    elif kind == 0:
        content["give_up"] = _place(rng, ["anywhere", "attention", "dead_ends"])
    elif kind == 1:
        content["charge_failing_step"] = not content["charge_failing_step"]
    elif kind == 2:
        budget = content["failure"]
        asked = [None, "least", "0", moved("0.3", rng)]
        stated = isinstance(budget, str) and budget != "least"
        content["failure"] = moved(budget, rng) if stated else _place(rng, asked)
    elif kind == 3 and content["rows"]:
        row = _place(rng, content["rows"])
        side = "at_most" if "at_most" in row else "at_least"
        row[side] = moved(row[side], rng)
    elif kind == 4 and content["rows"]:
        content["rows"].pop(int(rng.integers(len(content["rows"]))))
    elif kind == 5:
        quantity = _place(
            rng, [content["objective"], *(row["quantity"] for row in content["rows"])]
        )
        if quantity["terms"]:
            term = _place(rng, quantity["terms"])
            term[0] = moved(term[0], rng)
    elif kind == 6:
        begin = _place(rng, content["start"])
        begin[1] = int(rng.integers(content["states"]))
    else:
        content["greatest"] = not content["greatest"]
    return True


def change_state(
    content: dict[str, Any], rng: np.random.Generator, n: int, sets: list[str]
) -> bool:
    """Change a state of the model; whether something was changed."""
    kind, action = int(rng.integers(6)), _place(rng, content["actions"])
    if kind == 0 and sets:  # a label is lost, or gained
        name = _place(rng, sets)
        content["sets"] = [s for s in content["sets"] if s != name] + (
            [] if name in content["sets"] else [name]
        )
        return True
    if action is None:
        return False
    outcome = _place(rng, action[1])
    if kind == 1:
        outcome[1] = int(rng.integers(n))
    elif kind == 2:
        outcome[0] = moved(outcome[0], rng)
    elif kind == 3:
        k = int(rng.integers(len(action[2])))
        cost = action[2][k]
        if isinstance(cost, list):
            j = int(rng.integers(len(cost)))
            cost[j] = moved(cost[j], rng)
        else:
            action[2][k] = moved(cost, rng)
    elif kind == 4:
        content["actions"].remove(action)
    else:
        leads = [[moved("0.5", rng), int(rng.integers(n))] for _ in range(2)]
        content["actions"].append(["new", leads, [moved("1", rng) for _ in action[2]]])
    return True


def change_head(content: dict[str, Any], rng: np.random.Generator) -> bool:
    """Change weights, prices, the cap, the unit or a claimed ratio; whether something was."""
    name = _place(rng, list(content))
    if name in ("cap", "ratio"):
        content[name] = moved(content[name], rng)
        return True
    if name in ("unit", "lines"):
        content[name] = max(int(content[name] * 10.0 ** int(rng.integers(-3, 4))), 1)
        return True
    numbers = content[name]
    if not numbers:
        return False
    i, j = int(rng.integers(len(numbers))), int(rng.integers(len(numbers)))
    if rng.random() < 0.5 and i != j:
        numbers[i], numbers[j] = numbers[j], numbers[i]
        return True
    old, numbers[i] = numbers[i], moved(numbers[i], rng)
    if name == "weights" and i != j:  # and keep the sum
        numbers[j] = str(Fraction(numbers[j]) + Fraction(old) - Fraction(numbers[i]))
    return True


def whole(text: str, rng: np.random.Generator) -> str:
    """Another whole number, near or far."""
    return str(round(Fraction(moved(text, rng))))


def change_proof(content: list[Any], rng: np.random.Generator) -> bool:
    """Change values, decisions or vectors of a node; whether something was changed."""
    kind = int(rng.integers(5))
    entry = _place(rng, content[2:])
    if kind == 0:
        content[1] = None if content[1] is None or rng.random() < 0.1 else whole(content[1], rng)
    elif entry is None:
        return False
    elif kind == 1:
        entry[0] = int(rng.integers(3))
    elif kind == 2:
        entry[1] = int(rng.integers(4))
    elif kind == 3:
        j = int(rng.integers(2, len(entry)))
        entry[j] = int(whole(str(entry[j]), rng)) if j == 2 else whole(entry[j], rng)
    else:
        content.remove(entry)
    return True


def changed(lines: Lines, rng: np.random.Generator) -> tuple[str, Lines]:
    """A file with one change, and of what kind it is."""
    found, n = list(lines), json.loads(lines[0])["states"]
    sets = ["goal", *json.loads(lines[0])["sets"]]
    kind = _place(rng, ["question", "state", "state", "head", "proof", "proof", "proof", "lines"])
    heads = [k for k in range(n + 2, len(lines)) if lines[k][:1] == b"{"]
    nodes = [k for k in range(n + 2, len(lines)) if lines[k][:1] == b"["]
    at = {
        "question": 0,
        "state": 1 + int(rng.integers(n)),
        "head": _place(rng, heads),
        "proof": _place(rng, nodes),
    }.get(kind, int(rng.integers(1, len(lines))))
    if kind == "lines":
        other = int(rng.integers(1, len(lines)))
        if rng.random() < 0.3:
            del found[at]
        else:
            found[at], found[other] = found[other], found[at]
        return kind, found
    content = json.loads(found[at])
    change: Callable[[Any], bool] = {
        "question": lambda c: change_question(c, rng),
        "state": lambda c: change_state(c, rng, n, sets),
        "head": lambda c: change_head(c, rng),
        "proof": lambda c: change_proof(c, rng),
    }[kind]
    if not change(content):
        return changed(lines, rng)
    found[at] = json.dumps(content, separators=(",", ":")).encode()
    return kind, found


def check_changed(
    lines: Lines, folder: Path, rng: np.random.Generator, tally: Counter[str], problem: Any
) -> Iterator[str]:
    """Change a file once, check what is left, and yield what is not as it should be."""
    kind, found = changed(lines, rng)
    n = json.loads(lines[0])["states"]
    path = folder / "changed.cert"
    path.write_bytes(gzip.compress(b"".join(line + b"\n" for line in found)))
    checked = check_certificate(path)
    if not checked.accepted:
        reason = checked.reason.split(":")[0]
        tally[f"changed {kind}, refused"] += 1
        tally["refused as damaged"] += reason == "the file is damaged"
        return
    if found[: n + 1] != lines[: n + 1] and check_certificate(path, problem=problem).accepted:
        yield f"a {kind} was changed, and the file accepted as an answer to the first question"
    tally[f"changed {kind}, accepted"] += 1
    known = known_of(found, checked)
    if not holds(checked, known):
        yield f"{kind}: {interval(checked)} is accepted, the optimum is {known!r}"


def told(case: Case, seed: int, changes: int, tally: Counter[str]) -> Iterator[str]:
    """One problem: its certificate, and changed ones; yield what is not as it should be."""
    (problem, optimum_of_draw), name = question(case), case[1].criterion
    try:
        solution = solve(problem)
    except InfeasibleError:
        tally["infeasible"] += 1
        return
    except ModelError as error:
        tally[f"not solved: {str(error)[:70]}"] += 1
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.cert"
        try:
            written = write_certificate(solution, path)
        except ModelError as error:
            tally[f"not covered: {str(error)[:70]}"] += 1
            return
        except SSPError as error:
            tally["not proved"] += 1
            yield f"{name}: {error}"
            return
        tally["certificates"] += 1
        tally["widths of 0"] += written.lower == written.upper
        tally["rows exceeded by rounding"] += bool(written.exceeded)
        if (checked := check_certificate(path)) != written:
            yield f"{name}: written as {written}, read as {checked}"
        width = float(written.upper - written.lower) / (1.0 + abs(float(written.upper)))
        if not -AGREED < width < WIDTH:
            yield f"{name}: an interval of width {width:.1e}"
        lines = lines_of(path)
        tally[f"certificates of {name}"] += 1
        for source, known in (
            ("the question's program", known_of(lines, written)),
            ("the program of the draw", optimum_of_draw()),
            ("solve", solution.objective),
        ):
            if not holds(written, known):
                yield f"{name}: {source} has {known!r}, not in {interval(written)}"
        rng = np.random.default_rng([seed, 28])
        for _ in range(changes):
            yield from (
                f"{name}: {said}"
                for said in check_changed(lines, Path(folder), rng, tally, problem)
            )


def shrunk(seed: int, asked: argparse.Namespace) -> str:
    """The smallest problem of which something is wrong as of the draw of a seed."""

    def fails(case: Case) -> bool:
        try:
            return bool(list(told(case, seed, asked.changes, Counter())))
        except SSPError:
            return False  # it says what is wrong with the question

    return "\n".join(map(str, smallest(case_of(seed), smaller, fails)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Check draws from the command line; 1 if anything was found."""
    return run(
        __doc__,
        lambda seed, tally, asked: told(case_of(seed), seed, asked.changes, tally),
        arguments,
        options=lambda parser: parser.add_argument(
            "--changes", type=int, default=4, help="of each file"
        ),
        shrink=shrunk,
    )


if __name__ == "__main__":
    sys.exit(main())
