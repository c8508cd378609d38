"""Tasks against their definition on random traces, and against the best over all histories.

    python tests/campaigns/drawn_tasks.py --count 1000

Every draw has a formula and a small model. Fifty traces are judged by the automaton and by the
definition of the operators, position by position. The greatest probability with which the task
holds within a few steps, and that of reaching it, are those of a search over all histories.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Hashable, Iterable
from typing import Any

import numpy as np

from formulations import LeastQuantity, MaxProb
from ssp_lp import SSP, ModelError, certify, holds, reach, solve, task
from ssp_lp.model.task import Task
from tests.campaigns.campaign import run

CLOSE = 1e-9
Tree = tuple[Any, ...]
Trace = list[frozenset[str]]

EVERY = SSP.from_transitions(
    {
        (p, q): {a: [(0.2, (x, y), 1.0) for x in (0, 1) for y in (0, 1)] + [(0.2, "out", 1.0)]
                 for a in ("go", "wait")}
        for p in (0, 1) for q in (0, 1)
    },
    {"out"},
    state_labels={"p": [(1, 0), (1, 1)], "q": [(0, 1), (1, 1)]},
)  # fmt: skip
"""A model in which every trace over two labels and two actions is possible."""


def drawn_tree(rng: np.random.Generator, depth: int) -> Tree:
    """A random formula, as an operator and its parts."""
    if depth == 0 or rng.random() < 0.15:
        names = ["p", "q", "go", "wait"] * 3 + ["true", "false"]
        return (str(rng.choice(names)),)
    kind = str(rng.choice(["!", "X", "N", "F", "G", "U", "R", "&", "|", "->", "<->"]))
    parts = 1 if kind in "!XNFG" else 2
    return (kind, *(drawn_tree(rng, depth - 1) for _ in range(parts)))


def written(tree: Tree) -> str:
    """A formula as text."""
    kind, *parts = tree
    if not parts:
        return str(kind)
    if len(parts) == 1:
        return f"{kind} {written(parts[0])}"
    return f"({written(parts[0])} {kind} {written(parts[1])})"


def satisfied(tree: Tree, trace: Trace, at: int = 0) -> bool:
    """Whether a trace satisfies a formula from a position on, by definition."""
    kind, *parts = tree
    later, last = range(at, len(trace)), len(trace) - 1

    def of(k: int, position: int) -> bool:
        return satisfied(parts[k], trace, position)

    match kind:
        case "true" | "false":
            return bool(kind == "true")
        case "!":
            return not of(0, at)
        case "&":
            return of(0, at) and of(1, at)
        case "|":
            return of(0, at) or of(1, at)
        case "->":
            return not of(0, at) or of(1, at)
        case "<->":
            return of(0, at) == of(1, at)
        case "X":
            return at < last and of(0, at + 1)
        case "N":
            return at == last or of(0, at + 1)
        case "F":
            return any(of(0, k) for k in later)
        case "G":
            return all(of(0, k) for k in later)
        case "U":
            return any(of(1, k) and all(of(0, j) for j in range(at, k)) for k in later)
        case "R":
            return all(of(1, k) or any(of(0, j) for j in range(at, k)) for k in later)
    return kind in trace[at]


def positions(model: SSP, states: list[int], pairs: list[int]) -> Trace:
    """The trace of a run by its states and the pairs taken between them."""
    labels = [
        {name for name, members in model.state_labels.items() if state in members}
        for state in states
    ]
    actions = [{str(model.action_of(pair))} for pair in pairs] + [set()]
    return [frozenset(a | b) for a, b in zip(labels, actions, strict=True)]


def check_traces(tree: Tree, asked: Task, rng: np.random.Generator, count: int) -> Iterable[str]:
    """Traces that the automaton judges otherwise than the definition."""
    model = EVERY
    automaton, ends = asked.followed(model)
    for _ in range(count):
        state = int(rng.integers(4))
        states, pairs, value = [state], list[int](), 0
        for _ in range(int(rng.integers(6))):
            pair = int(rng.choice(model.pairs_of(state)))
            outcome = int(rng.integers(*model.outcome_offsets[pair : pair + 2]))
            value = int(automaton.moves[value, automaton.letter[outcome]])
            state = int(model.successors[outcome])
            states.append(state)
            pairs.append(pair)
            if model.goal_mask[state]:
                break
        trace = positions(model, states, pairs)
        if bool(ends[value, state]) != satisfied(tree, trace):
            yield f"{asked!r} on {trace}: {bool(ends[value, state])}"


def drawn_model(rng: np.random.Generator) -> SSP:
    """A model of four states, a goal and a dead-end."""
    states = ["a", "b", "c", "d"]
    moves: dict[Hashable, Any] = {"pit": {}}
    for state in states:
        moves[state] = {}
        for action in ("go", "wait")[: int(rng.integers(1, 3))]:
            ends = [str(end) for end in rng.choice([*states, "out", "out", "pit"], size=2)]
            moves[state][action] = [(0.25, ends[0], 1.0), (0.75, ends[1], 1.0)]
    moves["a"]["go"] = [(0.5, "b", 1.0), (0.5, "out", 1.0)]
    moves["b"]["wait"] = [(1.0, "c", 1.0)]
    labels = {"p": ["b", "d"], "q": ["c", "out"] if rng.random() < 0.5 else ["c", "d"]}
    return SSP.from_transitions(moves, {"out"}, state_labels=labels, dead_ends={"pit"})


def best(model: SSP, tree: Tree, steps: int, *, ends_at_once: bool) -> float:
    """Greatest probability, over all histories, with which a trace satisfies a formula.

    ends_at_once: whether it is enough that the trace so far does; else it must reach the goal.
    """

    def value(states: list[int], pairs: list[int]) -> float:
        state = states[-1]
        if (ends_at_once or model.goal_mask[state]) and satisfied(
            tree, positions(model, states, pairs)
        ):
            return 1.0
        if len(pairs) == steps:
            return 0.0
        return max(
            (
                sum(
                    float(model.probabilities[k])
                    * value([*states, int(model.successors[k])], [*pairs, pair])
                    for k in range(*model.outcome_offsets[pair : pair + 2])
                )
                for pair in model.pairs_of(state)
            ),
            default=0.0,
        )

    return value([model.index_of("a")], [])


def greatest(problem: Any) -> float:
    """The proved greatest probability that a problem asks for."""
    solution = solve(problem)
    assert certify(solution).accepted, "the certificate is refused"
    return float(solution.objective)


def told(seed: int, tally: Counter[str], traces: int = 50) -> Iterable[str]:
    """What is wrong with a draw."""
    rng = np.random.default_rng(seed)
    tree, steps = drawn_tree(rng, int(rng.integers(1, 4))), int(rng.integers(2, 5))
    asked = task(written(tree))
    tally["traces"] += traces
    yield from check_traces(tree, asked, rng, traces)
    model = drawn_model(rng)
    expected = best(model, tree, steps, ends_at_once=False)
    problem = LeastQuantity(model, "a", quantity=1.0 - holds(asked), horizon=steps)
    if abs(1.0 - greatest(problem) - expected) > CLOSE:
        yield f"holds({asked!r}) with {1.0 - greatest(problem)}, best {expected}"
    tally["held"] += expected > 0.0
    expected = best(model, tree, steps, ends_at_once=True)
    if satisfied(tree, positions(model, [model.index_of("a")], [])):
        tally["satisfied at the start"] += 1
        return
    try:
        made = reach(model, asked, start=["a"])
        found = greatest(MaxProb(made, made.start("a"), horizon=steps))
    except ModelError as error:
        found = 0.0 if "no run from the start satisfies" in str(error) else -1.0
    tally["reached"] += expected > 0.0
    if abs(found - expected) > CLOSE:
        yield f"reach({asked!r}) with {found}, best {expected}"


def check(seed: int, tally: Counter[str], asked: argparse.Namespace) -> Iterable[str]:
    """What is wrong with a draw, counted."""
    return told(seed, tally)


if __name__ == "__main__":
    sys.exit(run(__doc__, check))
