"""What campaigns share: draws by number from a command line, and the smallest one that fails.

A campaign draws problems by a seed and says in words what is wrong with the library's answer to
one. What it found it prints with the seed; where the problem is a table of outcomes by state and
action, also the smallest problem that is still wrong, which a few removals have made of it.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, TypeVar

import numpy as np

from ssp_lp import SSP, SSPError

Case = TypeVar("Case")
Table = Mapping[Any, Mapping[Any, Sequence[tuple[Any, Any, Any]]]]
"""Outcomes (probability, successor, cost) by state and action."""

MOST_TRIED = 500
"""Smaller problems that are tried for one that fails."""

LARGEST = 300
"""States of a model that is made smaller."""


def smaller_tables(table: Table, kept: Iterable[Any] = ()) -> Iterator[dict[Any, Any]]:
    """Tables with less in them, those with much less first.

    A state offers nothing any more; an action is left out; an outcome goes where another one does;
    a cost is 0 or 1.

    Args:
        table: the outcomes.
        kept: states that go on offering something.
    """

    def but(state: Any, actions: Mapping[Any, Any]) -> dict[Any, Any]:
        return {**table, state: dict(actions)}

    for state, actions in table.items():
        if actions and state not in kept:
            yield but(state, {})
    for state, actions in table.items():
        for gone in actions if len(actions) > 1 else ():
            yield but(state, {name: some for name, some in actions.items() if name != gone})
    for state, actions in table.items():
        for name, outcomes in actions.items():
            for k in range(len(outcomes) if len(outcomes) > 1 else 0):
                (first, *more), lost = [*outcomes[:k], *outcomes[k + 1 :]], outcomes[k][0]
                joined = [(first[0] + lost, *first[1:]), *more]
                yield but(state, {**actions, name: type(outcomes)(joined)})
    for state, actions in table.items():
        for name, outcomes in actions.items():
            for plain in (0, 1):
                simple = type(outcomes)([(p, to, type(cost)(plain)) for p, to, cost in outcomes])
                if simple != outcomes and all(cost > plain for _, _, cost in outcomes):
                    yield but(state, {**actions, name: simple})


def smallest(
    case: Case,
    smaller: Callable[[Case], Iterable[Case]],
    fails: Callable[[Case], bool],
    most: int = MOST_TRIED,
) -> Case:
    """The case that is left when no smaller one fails any more, or enough were tried."""
    tried = 0
    while tried < most:
        for candidate in islice(smaller(case), most - tried):
            tried += 1
            if fails(candidate):
                case = candidate
                break
        else:
            break
    return case


def smallest_model(model: SSP, fails: Callable[[SSP], object]) -> dict[Any, Any] | str:
    """The smallest model that fails as a given one does, which starts in its first state.

    Args:
        model: one that fails.
        fails: what is wrong with a model; one that the library refuses does not fail.

    Returns:
        Its outcomes by state and action, and the goals, by their numbers in the model given; of a
        large model only that it is large.
    """
    if model.n_states > LARGEST:
        return f"the model has {model.n_states:,} states"
    goals = np.flatnonzero(model.goal_mask).tolist()
    table: dict[Any, Any] = {s: {} for s in np.flatnonzero(~model.goal_mask).tolist()}
    pairs = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    columns = model.probabilities, model.successors, np.broadcast_to(model.costs, pairs.shape)
    steps = zip(*(column.tolist() for column in columns), strict=True)
    for pair, step in zip(pairs.tolist(), steps, strict=True):
        table[int(model.pair_state[pair])].setdefault(pair, []).append(step)

    def still(case: Table) -> bool:
        try:
            stated = SSP.from_transitions(case, goals, treat_actionless_as_dead_ends=True)
            return bool(fails(stated))
        except (SSPError, ValueError):
            return False

    left = smallest(table, lambda case: smaller_tables(case, kept=[0]), still)
    return {state: actions for state, actions in left.items() if actions} | {"goals": goals}


def run(
    told: str | None,
    check: Callable[[int, Counter[str], argparse.Namespace], Iterable[str]],
    arguments: Sequence[str] | None = None,
    *,
    count: int = 200,
    options: Callable[[argparse.ArgumentParser], Any] = lambda parser: None,
    shrink: Callable[[int, argparse.Namespace], object] | None = None,
) -> int:
    """Check draws from a command line, and print what is wrong and a tally; 1 if anything was.

    Args:
        told: what the campaign is, in words.
        check: of the draw of a seed what is wrong; it counts what it does.
        arguments: of the command line.
        count: of the draws, unless asked for otherwise.
        options: adds to the command line.
        shrink: the smallest draw that fails as that of the seed does; it is printed.
    """
    parser = argparse.ArgumentParser(
        description=told, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=count, help="of draws")
    parser.add_argument("--seed", type=int, default=0, help="of the first draw")
    options(parser)
    asked = parser.parse_args(arguments)
    tally, began, wrong = Counter[str](), time.process_time(), 0
    for seed in range(asked.seed, asked.seed + asked.count):
        found = list(check(seed, tally, asked))
        wrong += bool(found)
        for said in found:
            print(f"seed {seed}: {said}", flush=True)
        if found and shrink is not None:
            print(f"seed {seed}, the smallest that fails:\n{shrink(seed, asked)}", flush=True)
    for name, times in sorted(tally.items()):
        print(f"{name:<60} {times:,}")
    print(f"{asked.count:,} draws, {wrong:,} wrong; {time.process_time() - began:.0f} s")
    return int(wrong > 0)
