"""Check a certificate: ``python certificate_lines.py FILE`` prints the question and the result.

With ``expand.py`` and ``prove.py`` beside it, this needs Python's standard library alone. A file is
unpacked and read line by line: the question, a line for each state, and the proof of each program
of the question. Most questions have one program. If least failure or a share of the greatest goal
probability is asked for, a first program proves the least failure, which bounds the failure in the
second one. A quantile B of the total C given success, at a level L, needs two programs: the first
proves Pr(C > B) <= 1 - L for some lottery, the second Pr(C >= B) > 1 - L for every lottery.
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
    from .expand import Action, Program, State, in_parts
    from .prove import Bounds, Member, Proof, need, number, prove, whole
else:  # this file was copied elsewhere
    from expand import Action, Program, State, in_parts  # type: ignore
    from prove import Bounds, Member, Proof, need, number, prove, whole  # type: ignore

FORMAT = "ssp-lp certificate 2"
KINDS = {
    "format": str, "states": int, "costs": int, "sets": list, "start": list, "give_up": str,
    "charge_failing_step": bool, "greatest": bool, "objective": dict, "failure": object,
    "discount": object, "horizon": object, "rows": list, "ratio": bool, "charge": list,
    "quantile": object,
}  # fmt: skip
LINE, TIMES = 1 << 24, 100  # most bytes of a line; most bytes beyond one line, per byte of the file
LARGE = 10**400  # limit of units and of counts of steps
NOTHING: dict[str, Any] = {"constant": "0", "terms": []}
ALONE = {"ratio": True, "greatest": False, "charge": [], "discount": None, "objective": NOTHING}
FAILING = {"constant": "1", "terms": [["-1", "end", "goal"]]}
Question = dict[str, Any]
Lines = Callable[[], Iterator[bytes]]  # lines of a file, from the first one at each call


def lines_of(path: Any) -> Lines:
    """Return a function that reads a packed file line by line, from its first line at each call.

    A line that is too long is refused, and so are lines that are too many for the file's size.
    """

    def lines() -> Iterator[bytes]:
        with open(path, "rb") as packed, gzip.open(packed) as file:
            left = LINE + TIMES * packed.seek(0, 2)
            packed.seek(0)
            while line := file.readline(LINE):
                left -= len(line)
                need(left >= 0, "the lines are too long for so small a file")
                need(line.endswith(b"\n"), "a line is not ended, or has more than", LINE, "bytes")
                yield line

    return lines


def read(line: bytes, **kinds: type) -> Any:
    """Return a line's content: an object with exactly the given keys, or, without keys, a list."""

    def once(pairs: list[tuple[str, Any]]) -> Question:
        need(len(dict(pairs)) == len(pairs), "a key comes twice:", *(key for key, _ in pairs))
        return dict(pairs)

    content = json.loads(line.decode(), object_pairs_hook=once)
    need(content.keys() == kinds.keys() if kinds else type(content) is list, "no line of:", *kinds)
    for key, kind in kinds.items():
        need(kind is object or type(content[key]) is kind, key, "is", repr(content[key])[:99])
    return content


def read_question(lines: Iterator[bytes]) -> tuple[Question, str, Any]:
    """Read the question, the SHA-256 of question and model, and the claimed value of a quantile."""
    question, digest = read(first := next(lines), **KINDS), hashlib.sha256(first)
    need(question["format"] == FORMAT, "this is not a certificate of this format")
    for line in islice(lines, whole(question["states"], LARGE)):
        digest.update(line)
    is_alone = question["quantile"] is None or {**question, **ALONE} == question
    need(is_alone, "needed: a quantile is one of the total alone, given success")
    answer = read(next(lines), answer=object)["answer"]
    need((answer is None) == (question["quantile"] is None), "needed: an answer is a quantile")
    return question, digest.hexdigest(), answer


def read_state(line: bytes, question: Question) -> State:
    """Read a state of the certified model from its line, with normalised probabilities."""
    stated, actions = read(line, name=str, sets=list, actions=list), list[Action]()
    for name, outcomes, costs in stated["actions"]:
        weights, _ = in_parts([number(p) for p, _ in outcomes])
        total, place, means = sum(weights), (stated["name"], name), list[Fraction]()
        need(min(weights, default=-1) >= 0 < total, "needed: chances >= 0 of a sum > 0 at", *place)
        need(type(costs) is list and len(costs) == question["costs"], "costs of", *place)
        first = [Fraction(0)] * len(weights)
        for j, cost in enumerate(costs):
            paid = list(map(number, cost if type(cost) is list else [cost]))
            times = 1 if type(cost) is list else len(weights)
            need(times * len(paid) == len(weights) and min(paid) >= 0, "costs >= 0 at", *place)
            parts, scale = in_parts(paid)
            means.append(Fraction(sum(map(mul, weights, times * parts)), total * scale))
            first = first if j else times * paid
        each = zip(weights, outcomes, first, strict=True)
        moves = [(a, whole(y, question["states"]), t) for a, (_, y), t in each if a]
        actions.append(Action(name, total, moves, means))
    need("goal" not in stated["sets"] or not actions, "needed: a goal has no actions")
    return State(stated["name"], stated["sets"], actions)


def model_of(lines: Lines, question: Question) -> Iterator[State]:
    """Yield the states of the model in a file."""
    return (read_state(line, question) for line in islice(lines(), 1, 1 + question["states"]))


def read_proof(lines: Iterator[bytes], *, ratio: bool) -> tuple[Proof, str, int]:
    """Read the next proof of a file; return it with its cap and the number of its nodes."""
    kinds = {"cap": str, "prices": list, "weights": list, "unit": int, "lines": int}
    head = read(next(lines), **kinds, **({"ratio": str} if ratio else {}))
    prices, weights = (list(map(number, head[key])) for key in ("prices", "weights"))
    members, last, count = [Member() for _ in weights], -1, whole(head["lines"], LARGE)
    least, unit = number(head["ratio"]) if ratio else None, 1 + whole(head["unit"] - 1, LARGE)
    proof = Proof(unit, prices, weights, least, {}, members)
    for line in islice(lines, count):
        node, v, *told = read(line)
        need(last < whole(node, LARGE) and (v or told), "nodes come in their order, not", node)
        last, count = node, count - 1
        if v is not None:
            proof.v[node] = in_units(v)
        for m, decision, t, *u in told:
            need(node not in (member := members[whole(m, len(members))]).t, "member twice at", node)
            member.decision[node], member.t[node] = whole(decision, LARGE), whole(t, LARGE)
            member.u[node] = list(map(in_units, u))
    need(count == 0, "the file ends within a proof")
    return proof, head["cap"], len(proof.v.keys() | {i for one in members for i in one.t})


def in_units(text: Any) -> int:
    """Convert a text to a whole number, a value in units of the proof."""
    need(number(text).denominator == 1, "no whole number of units:", text)
    return int(number(text))


def steps_of(question: Question) -> list[str]:
    """Return the names of a question's programs in the order of their proofs in the file."""
    is_share = type(question["failure"]) is dict or question["failure"] == "least"
    return ["least"] * is_share + (["main"] if question["quantile"] is None else ["late", "from"])


def stated(question: Question, step: str, answer: Any, done: dict[str, Bounds]) -> Question:
    """Return the question of one program: the file's question with some fields replaced.

    The field `failure` becomes an interval that contains the bound. For a quantile, `charge`
    becomes 1 for a total above the answer (program "late"), or for a total of at least the answer
    ("from").

    Args:
        question: the question of the file.
        step: name of the program.
        answer: the value of a quantile, or None.
        done: intervals that the earlier programs have proved, by name.
    """
    if step == "least":
        return {**question, "failure": (Fraction(1), Fraction(1)), "objective": FAILING, "rows": [],
                "charge": [], "ratio": False, "greatest": False}  # fmt: skip
    failure, charge = question["failure"], question["charge"]
    if "least" in done:
        failure = {"share": "1"} if failure == "least" else failure
        need(failure.keys() == {"share"}, "a share has one number")
        share = number(failure["share"])
        need(0 <= share <= 1, "needed: a share is a probability")
        allowed = tuple(1 - share * (1 - max(end, Fraction(0))) for end in done["least"][:2])
    else:
        allowed = 2 * (number("1" if failure is None else failure),)
    if step != "main":
        late = [[">=", "0", "0", "0"], [">" if step == "late" else ">=", answer, "1", "0"]]
        charge = late if step == "late" or number(answer) else [[">=", "0", "1", "0"]]
    return {**question, "failure": allowed, "charge": charge}


def proved_steps(
    lines: Lines, rest: Iterator[bytes], question: Question, answer: Any
) -> Iterator[tuple[Program, Proof, Bounds, str]]:
    """Check the proofs of a question's programs one by one.

    Args:
        lines: lines of the file.
        rest: the file's remaining lines, after the model.
        question: the question of the file.
        answer: the value of a quantile; None: the question asks for no quantile.

    Yields:
        Each program, its proof, the interval that it proves, and the SHA-256 of its text.
    """
    done = dict[str, Bounds]()
    for name in steps_of(question):
        asked, digest = stated(question, name, answer, done), hashlib.sha256()
        proof, cap, count = read_proof(rest, ratio=asked["ratio"])
        program = Program(asked, lambda: model_of(lines, question), cap, count)
        columns, constant = digested(program, digest), program.objective.constant
        done[name] = prove(columns, constant, program.rows, program.follows, proof)
        yield program, proof, done[name], digest.hexdigest()
    need(next(rest, None) is None, "the file has lines after its proof")


def digested(program: Program, digest: Any) -> Iterator[Any]:
    """Yield the columns of a program, and update ``digest`` by the text of the program."""
    rows = [[row.name, str(row.least), str(row.most)] for row in program.rows]
    head = [program.size, str(program.objective.constant), rows, list(program.follows.items())]
    digest.update(json.dumps(head, separators=(",", ":")).encode() + b"\n")
    for column in program.columns():
        line = json.dumps([*column[:4], list(map(str, column.counts))], separators=(",", ":"))
        digest.update(line.encode() + b"\n")
        yield column


def check(lines: Lines, expected: str | None = None) -> tuple[Bounds, Question, list[str]]:
    """Check a certificate; return the proved interval, the question, and SHA-256 sums.

    The first SHA-256 is that of question and model, the others are those of the programs.

    Args:
        lines: function that returns an iterator over all lines of the file.
        expected: SHA-256 that the question and the model must have; None: any.

    Raises:
        RefusedError: the claim does not follow.
    """
    question, digest, answer = read_question(rest := lines())
    need(expected in (None, digest), "the file answers another question, of SHA-256", digest)
    steps = [step[1:] for step in proved_steps(lines, rest, question, answer)]
    bounds, digests = [step[1] for step in steps], [digest, *(step[2] for step in steps)]
    exceeded = {name: most for one in bounds for name, most in one.exceeded.items()}
    lower, upper, _ = bounds[-1]
    if question["quantile"] is not None:
        late = 1 - number(question["quantile"])
        need(bounds[-2].upper <= late, "needed: the lottery exceeds the quantile rarely enough")
        need(not exceeded, "a quantile jumps where the lottery exceeds row", *exceeded)
        need(lower > late, "needed: no lottery stays below the quantile often enough")
        lower = upper = number(answer)
    lower, upper = (-upper, -lower) if question["greatest"] else (lower, upper)
    return Bounds(lower, upper, exceeded), question, digests


def main(path: str, expected: str | None = None) -> int:
    """Print the question of a file and the interval that it proves, or why it is refused."""
    try:
        bounds, question, digests = check(lines_of(path), expected)
    except Exception as error:  # whatever a damaged file may lead to
        print(f"refused: {type(error).__name__} {str(error)!a}")
        return 1
    print("accepted:", json.dumps(question))
    print(f"its optimum lies between {float(bounds.lower)!r} and {float(bounds.upper)!r}")
    print("SHA-256:", *digests, "rows that the lottery exceeds:", *map(ascii, bounds.exceeded))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
