"""Check a certificate: ``python certificate_lines.py FILE`` says what it proves of which question.

With ``expand.py`` and ``prove.py`` beside it this needs Python's standard library alone. A file is
unpacked and read line by line: the question, a line for each state, and the proof of each program
of the question. Least failure, or a share of the greatest goal probability, is proved first, and
bounds the failure that the second program allows. A quantile B is two programs, too: given
success, the total exceeds B rarely enough under a lottery, and is at least B too often under all.
"""

import gzip
import hashlib
import json
import sys
from collections.abc import Callable, Iterator
from fractions import Fraction
from itertools import islice
from operator import mul
from typing import Any

if __package__:
    from .expand import Action, Program, State, common
    from .prove import Bounds, Column, Member, Proof, RefusedError, need, number, prove, whole
else:  # copied elsewhere
    from expand import Action, Program, State, common  # type: ignore
    from prove import (  # type: ignore
        Bounds,
        Column,
        Member,
        Proof,
        RefusedError,
        need,
        number,
        prove,
        whole,
    )  # fmt: skip

FORMAT = "ssp-lp certificate 2"
KINDS = {
    "format": str, "states": int, "costs": int, "sets": list, "start": list, "give_up": str,
    "charge_failing_step": bool, "greatest": bool, "objective": dict, "failure": object,
    "discount": object, "horizon": object, "rows": list, "ratio": bool, "charge": list,
    "quantile": object,
}  # fmt: skip
LINE, TIMES = 1 << 24, 100  # most bytes of a line; of all, per byte of the file, behind a line's
LARGE = 10**400  # than which units and counts of steps are smaller
NOTHING = {"constant": "0", "terms": list[Any]()}
FAILING = {"constant": "1", "terms": [["-1", "end", "goal"]]}
Lines = Callable[[], Iterator[bytes]]  # of a file, from the first one on each time
Step = tuple[Program, Proof, Bounds, str]  # of a question, proved; SHA-256 of the program's text


def lines_of(path: Any) -> Lines:
    """Lines of a file, no more and no longer than its size allows."""

    def lines() -> Iterator[bytes]:
        with open(path, "rb") as packed, gzip.open(packed) as file:
            left = LINE + TIMES * packed.seek(0, 2)
            packed.seek(0)
            while line := file.readline(LINE + 1):
                left -= len(line)
                need(len(line) <= LINE, "a line has more than", LINE, "bytes")
                need(left >= 0, "the lines are too long for so small a file")
                need(line.endswith(b"\n"), "a line is not ended")
                yield line

    return lines


def read(line: bytes, **kinds: type) -> Any:
    """Content of a line: an object of these keys, else a list; no key comes twice."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        need(len(dict(pairs)) == len(pairs), "a key comes twice:", *(key for key, _ in pairs))
        return dict(pairs)

    content = json.loads(line, object_pairs_hook=once)
    need(type(content) is (dict if kinds else list), "no line of this kind")
    need(not kinds or content.keys() == kinds.keys(), "the keys of a line are not", *kinds)
    for key, kind in kinds.items():
        need(kind is object or type(content[key]) is kind, key, "is", repr(content[key])[:99])
    return content


def read_question(lines: Iterator[bytes]) -> tuple[dict[str, Any], str]:
    """The question, and the SHA-256 of it and the model."""
    question, digest = read(first := next(lines), **KINDS), hashlib.sha256(first)
    need(question["format"] == FORMAT, "this is no certificate of this format")
    for line in islice(lines, whole(question["states"], LARGE)):
        digest.update(line)
    alone = question["ratio"] and not question["greatest"] and not question["charge"]
    alone = alone and question["discount"] is None and question["objective"] == NOTHING
    is_one = question["quantile"] is None or alone
    need(is_one, "a quantile is one of the total alone, given success, fails")
    return question, digest.hexdigest()


def in_parts(numbers: list[Fraction]) -> tuple[list[int], int]:
    """Numbers as multiples of one over their common denominator."""
    scale = common(numbers)
    return [one.numerator * (scale // one.denominator) for one in numbers], scale


def read_state(line: bytes, question: dict[str, Any]) -> State:
    """A state of the model, its chances divided by their sum, its costs averaged."""
    stated, actions = read(line, name=str, sets=list, actions=list), list[Action]()
    for name, outcomes, costs in stated["actions"]:
        weights, _ = in_parts([number(p) for p, _ in outcomes])
        total, place, means = sum(weights), (stated["name"], name), list[Fraction]()
        need(min(weights, default=-1) >= 0 < total, "chances >= 0 of a sum > 0, fails at", *place)
        is_list = type(costs) is list and len(costs) == question["costs"]
        need(type(name) is str and is_list, "costs of", *place)
        first = [Fraction(0)] * len(weights)
        for j, cost in enumerate(costs):
            paid = [number(c) for c in cost] if type(cost) is list else [number(cost)] * len(first)
            need(len(paid) == len(first) and min(paid) >= 0, "costs >= 0, fails at", *place)
            first = first if j else paid
            if paid.count(paid[0]) == len(paid):
                means.append(paid[0])
                continue
            parts, scale = in_parts(paid)
            means.append(Fraction(sum(map(mul, weights, parts)), total * scale))
        each = zip(weights, outcomes, first, strict=True)
        moves = [(a, whole(y, question["states"]), t) for a, (_, y), t in each if a]
        actions.append(Action(name, total, moves, means))
    need("goal" not in stated["sets"] or not actions, "a goal has no actions, fails")
    return State(stated["name"], stated["sets"], actions)


def read_proof(lines: Iterator[bytes], *, ratio: bool) -> tuple[Proof, str, int]:
    """The next proof of a file, its cap, and how many nodes it has a line for."""
    kinds = {"cap": str, "prices": list, "weights": list, "unit": int, "lines": int}
    head = read(next(lines), **kinds, **({"ratio": str} if ratio else {}))
    prices, weights = (list(map(number, head[key])) for key in ("prices", "weights"))
    members, last, count = [Member() for _ in weights], -1, whole(head["lines"], LARGE)
    least, unit = number(head["ratio"]) if ratio else None, 1 + whole(head["unit"] - 1, LARGE)
    proof = Proof(unit, prices, weights, least, {}, members)
    for line in islice(lines, count):
        node, v, *entries = read(line)
        need(last < whole(node, LARGE), "nodes come in their order, fails at", node)
        last = node
        if v is not None:
            proof.v[node] = in_units(v)
        for m, decision, t, *u in entries:
            member = members[whole(m, len(members))]
            member.decision[node], member.t[node] = whole(decision, LARGE), whole(t, LARGE)
            member.u[node] = list(map(in_units, u))
    return proof, head["cap"], len(proof.v.keys() | {i for one in members for i in one.t})


def in_units(text: Any) -> int:
    """Whole number of units that a text states."""
    need(number(text).denominator == 1, "no whole number of units:", text)
    return int(number(text))


def steps_of(question: dict[str, Any]) -> list[str]:
    """Names of the programs of a question, in their order."""
    failure = question["failure"]
    first = ["least"] if type(failure) is dict or failure == "least" else []
    return first + (["main"] if question["quantile"] is None else ["late", "from"])


def stated(
    question: dict[str, Any], step: str, answer: Any, done: dict[str, Bounds]
) -> dict[str, Any]:
    """The question of a program: the failure that it allows is an interval, a quantile a charge."""
    if step == "least":
        return {**question, "failure": (Fraction(1), Fraction(1)), "objective": FAILING, "rows": [],
                "charge": [], "ratio": False, "greatest": False}  # fmt: skip
    failure, charge = question["failure"], question["charge"]
    if "least" in done:
        failure = {"share": "1"} if failure == "least" else failure
        need(failure.keys() == {"share"}, "a share has one number")
        share = number(failure["share"])
        need(0 <= share <= 1, "a share is a probability, fails")
        allowed = tuple(1 - share * (1 - max(end, Fraction(0))) for end in done["least"][:2])
    else:
        allowed = 2 * (number("1" if failure is None else failure),)
    if step != "main":
        is_start = step == "from" and not number(answer)
        late = [">=", "0", "0", "0"], [">" if step == "late" else ">=", answer, "1", "0"]
        charge = [[">=", "0", "1", "0"]] if is_start else list(late)
    return {**question, "failure": allowed, "charge": charge}


def proved_steps(lines: Lines, rest: Iterator[bytes], question: dict[str, Any]) -> Iterator[Step]:
    """Check the proofs of a question's programs one after the other.

    Args:
        lines: of the file.
        rest: the same, behind the model.
        question: of the file.
    """
    answer, done = read(next(rest), answer=object)["answer"], dict[str, Bounds]()
    need((answer is None) == (question["quantile"] is None), "an answer is a quantile, fails")
    for name in steps_of(question):
        asked, digest = stated(question, name, answer, done), hashlib.sha256()
        proof, cap, count = read_proof(rest, ratio=asked["ratio"])

        def states() -> Iterator[State]:
            model = islice(lines(), 1, 1 + question["states"])
            return (read_state(line, question) for line in model)

        program = Program(asked, states, cap, count)
        columns = digested(program, digest)
        constant, rows = program.objective.constant, program.rows
        done[name] = prove(columns, constant, rows, program.follows, proof)
        yield program, proof, done[name], digest.hexdigest()
    need(next(rest, None) is None, "the file goes on behind its proof")


def digested(program: Program, digest: Any) -> Iterator[Column]:
    """Columns of a program, while its text is digested, for others to compare with."""
    rows = [[row.name, str(row.least), str(row.most)] for row in program.rows]
    follows = sorted(program.follows.items())
    head = [program.size, str(program.objective.constant), rows, follows]
    digest.update(json.dumps(head, separators=(",", ":")).encode() + b"\n")
    for column in program.columns():
        line = [*column[:4], list(map(str, column.counts))]
        digest.update(json.dumps(line, separators=(",", ":")).encode() + b"\n")
        yield column


def check(lines: Lines, expected: str | None = None) -> tuple[Bounds, dict[str, Any], list[str]]:
    """Interval that a file's lines prove, the question, and the SHA-256 of it and each program.

    Args:
        lines: of the file, from the first one on each time.
        expected: SHA-256 of the question and the model that are asked about; None: any.

    Raises:
        RefusedError: the claim does not follow.
    """
    rest = lines()
    question, digest = read_question(rest)
    need(expected in (None, digest), "the file answers another question, of SHA-256", digest)
    bounds, exceeded, digests = list[Bounds](), dict[str, Fraction](), [digest]
    for step in proved_steps(lines, rest, question):
        asked = step[0].question
        bounds.append(step[2])
        exceeded |= step[2].exceeded
        digests.append(step[3])
    lower, upper, _ = bounds[-1]
    if question["quantile"] is not None:
        late, answer = 1 - number(question["quantile"]), asked["charge"][-1][1]
        need(bounds[-2].upper <= late, "the lottery exceeds the quantile as rarely, fails")
        need(not exceeded, "a quantile jumps where the lottery exceeds row", *exceeded)
        need(lower > late, "no lottery stays below the quantile as often, fails")
        lower = upper = number(answer)
    if question["greatest"]:
        lower, upper = -upper, -lower
    return Bounds(lower, upper, exceeded), question, digests


def main(path: str, expected: str | None = None) -> int:
    """Print what a file proves of the question in it, or why it is refused."""
    try:
        bounds, question, digests = check(lines_of(path), expected)
    except Exception as error:  # whatever a damaged file may lead to
        told = "" if isinstance(error, RefusedError) else f"the file is damaged: {type(error)}: "
        print(f"refused: {told}{str(error)!a}")
        return 1
    print("accepted:", json.dumps(question))
    print(f"its optimum lies between {float(bounds.lower)!r} and {float(bounds.upper)!r}")
    print("SHA-256 of the question, and of the programs:", *digests)
    for name, excess in bounds.exceeded.items():
        print(f"the lottery exceeds row {name!a} by {float(excess):.1e}")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
