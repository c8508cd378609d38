"""Whether two models behave alike: the coarsest bisimulation of both, by refinement of colours."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ssp_lp import SSP
from ssp_lp.model.graph import dead_ends

DIGITS = 12
"""Probabilities and costs that agree to so many digits are the same."""

Steps = list[list[tuple[float, float, int]]]
"""The actions of a state, as lists of (probability, cost, successor)."""


@dataclass(frozen=True)
class Likeness:
    """How alike two models are, seen from their starts.

    The starts of bisimilar models have the same choices of lotteries over costs and equal
    successors, and so on: all values of all criteria are the same. If the largest class is 1,
    models of the same classes are copies of each other but for their dead-ends and goals.
    """

    bisimilar: bool
    same_classes: bool  # every class of equal states has as many members in both
    largest_class: int  # members of the largest class with actions in the first model


def compare(first: SSP, first_start: int, second: SSP, second_start: int) -> Likeness:
    """Compare what can be reached from the starts; a dead-end is one whatever its actions."""
    begin, one = _steps(first, first_start, 0)
    then, two = _steps(second, second_start, first.n_states)
    colour = _refine({**begin, **then}, {**one, **two})
    sizes = [Counter(colour[s] for s in part) for part in (begin, then)]
    acting = Counter(colour[s] for s in begin if one[s])
    return Likeness(
        bisimilar=colour[first_start] == colour[first.n_states + second_start],
        same_classes=sizes[0] == sizes[1],
        largest_class=max(acting.values()),
    )


def _steps(model: SSP, start: int, offset: int) -> tuple[dict[int, int], dict[int, Steps]]:
    """First colours (goal 1, dead-end 2, others 0) and actions of the reachable states."""
    dead = dead_ends(model)
    colour, steps = {}, {}
    found, seen = [start], {start}
    for state in found:  # which grows
        colour[offset + state] = 1 if model.goal_mask[state] else 2 * int(dead[state])
        pairs = range(model.pair_offsets[state], model.pair_offsets[state + 1])
        ahead = np.arange(*model.outcome_offsets[[pairs.start, pairs.stop]])
        new = set(model.successors[ahead[model.probabilities[ahead] > 0.0]].tolist()) - seen
        found += sorted(new)
        seen |= new
        steps[offset + state] = [] if dead[state] else [_outcomes(model, k, offset) for k in pairs]
    return colour, steps


def _outcomes(model: SSP, pair: int, offset: int) -> list[tuple[float, float, int]]:
    some = slice(model.outcome_offsets[pair], model.outcome_offsets[pair + 1])
    return [
        (round(float(p), DIGITS), round(float(c), DIGITS), offset + int(s))
        for p, c, s in zip(
            model.probabilities[some], model.costs[some], model.successors[some], strict=True
        )
    ]


def _refine(colour: dict[int, int], steps: dict[int, Steps]) -> dict[int, int]:
    """Split colours by what the actions do until nothing splits any more."""
    while True:
        names: dict[object, int] = {}
        finer = {}
        for state, old in colour.items():
            actions = sorted(
                sorted((p, c, colour[successor]) for p, c, successor in outcomes)
                for outcomes in steps[state]
            )
            look = (old, tuple(map(tuple, actions)))
            finer[state] = names.setdefault(look, len(names))
        if len(names) == len(set(colour.values())):
            return finer
        colour = finer
