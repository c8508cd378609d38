"""A model as other tools want it: one cost for each action, and an action in every state."""

from __future__ import annotations

import gzip
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ssp_lp.arrays import FloatArray, IntArray, offsets_of
from ssp_lp.errors import ModelError
from ssp_lp.io.model_files.decimals import decimal_sum, distinct_decimal_pairs
from ssp_lp.io.model_files.raw_model import DEADLOCK, INITIAL, PAY, PAYING
from ssp_lp.io.model_files.text_file import FilePath
from ssp_lp.model import SSP

GOAL = "goal"

_OWN_ACTIONS = ("stay", PAY)
_GZIP_LEVEL = 6  # the usual compromise of size and time; 9 takes several times as long
_BAD_LABEL = re.compile(r'["\\\x00-\x1f]|//')


class Exported(NamedTuple):
    """A Markov decision process with a cost for each action.

    Its states are those of the model, then states that pay: an outcome that costs more than the
    cheapest of its action leads to its successor through one that pays what is missing. Goal
    states and dead-ends stay where they are.
    """

    pair_offsets: IntArray  # [states + 1]
    outcome_offsets: IntArray  # [pairs + 1]
    successors: IntArray  # [outcomes], rising within each pair
    probabilities: FloatArray  # [outcomes]
    costs: FloatArray  # [pairs]
    actions: Sequence[str]  # [pairs] words, distinct within each state
    labels: Mapping[str, IntArray]  # label -> states
    choice_of_pair: IntArray  # [pairs of the model]
    target_of_outcome: IntArray  # [outcomes of the model] the next state; -1: it never occurs


class _Outcomes(NamedTuple):
    """Outcomes that occur, one after the other."""

    pairs: IntArray  # [outcomes]
    successors: IntArray  # [outcomes]
    probabilities: FloatArray  # [outcomes]


class _Payments(NamedTuple):
    """What the actions pay, and the states that pay the rest."""

    costs: FloatArray  # [pairs]
    successors: IntArray  # [paying states] the state that follows
    rests: FloatArray  # [paying states]


def exported(model: SSP, start: Hashable) -> Exported:
    """Rewrite a model for another tool.

    Args:
        model: the model.
        start: the state that is labelled "init".

    Raises:
        ModelError: the start is no state, or a label cannot be written.
    """
    outcomes, payments = _exported_costs(model)
    idle = np.flatnonzero(np.diff(model.pair_offsets) == 0)
    before = np.searchsorted(idle, model.pair_state)
    # new numbers of the model's pairs, of the loops of states that had none, of those that pay
    own = np.arange(model.n_pairs) + before
    loops = model.pair_offsets[idle] + np.arange(idle.size)
    paying = np.arange(payments.rests.size) + model.n_pairs + idle.size
    place = np.concatenate([own, loops, paying])
    lengths = np.ones(idle.size + paying.size)
    final = _merged_for_export(
        _Outcomes(
            np.concatenate([own[outcomes.pairs], loops, paying]),
            np.concatenate([outcomes.successors, idle, payments.successors]),
            np.concatenate([outcomes.probabilities, lengths]),
        )
    )
    costs, code = np.zeros(place.size), np.empty(place.size, dtype=np.int64)
    costs[own], costs[paying] = payments.costs, payments.rests
    names = [*_exported_words(model.action_names), *_OWN_ACTIONS]
    code[own], code[loops], code[paying] = model.pair_action, len(names) - 2, len(names) - 1
    counts = np.concatenate([np.maximum(np.diff(model.pair_offsets), 1), np.ones_like(paying)])
    targets = np.full(model.n_outcomes, -1, dtype=np.int64)
    targets[model.probabilities > 0.0] = outcomes.successors
    return Exported(
        pair_offsets=offsets_of(counts),
        outcome_offsets=offsets_of(np.bincount(final.pairs, minlength=place.size)),
        successors=final.successors,
        probabilities=final.probabilities,
        costs=costs,
        actions=[names[k] for k in code.tolist()],
        labels=_exported_labels(model, start, idle, paying.size),
        choice_of_pair=own,
        target_of_outcome=targets,
    )


def _exported_costs(model: SSP) -> tuple[_Outcomes, _Payments]:
    """Split the costs of outcomes: the least of the pair at once, the rest on the way."""
    occurs = model.probabilities > 0.0
    pairs = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))[occurs]
    successors = model.successors[occurs].astype(np.int64)
    costs = model.costs[occurs]
    firsts = np.searchsorted(pairs, np.arange(model.n_pairs))
    least = np.minimum.reduceat(costs, firsts) if costs.size else np.zeros(0)
    late = np.flatnonzero(costs > least[pairs])
    meant = dict(model.exact_costs) | {-cost: -exact for cost, exact in model.exact_costs.items()}
    rest = decimal_sum(costs[late], -least[pairs[late]], meant)
    following, rests, kind = distinct_decimal_pairs(successors[late].astype(np.float64), rest)
    successors[late] = model.n_states + kind
    payments = _Payments(least, following.astype(np.int64), rests)
    return _Outcomes(pairs, successors, model.probabilities[occurs]), payments


def _merged_for_export(outcomes: _Outcomes) -> _Outcomes:
    """Sort by pair and successor, and add the probabilities of those that are the same."""
    order = np.lexsort((outcomes.successors, outcomes.pairs))
    pairs, successors = outcomes.pairs[order], outcomes.successors[order]
    new = np.ones(order.size, dtype=np.bool_)
    new[1:] = (np.diff(pairs) != 0) | (np.diff(successors) != 0)
    firsts = np.flatnonzero(new)
    chance = np.add.reduceat(outcomes.probabilities[order], firsts)
    return _Outcomes(pairs[firsts], successors[firsts], chance)


def _exported_words(names: Sequence[Hashable]) -> list[str]:
    """Names as distinct words of letters, digits and a few signs."""
    taken: set[str] = set()
    words = []
    for position, name in enumerate(names):
        word = re.sub(r"[^A-Za-z0-9_.+-]+", "_", str(name)).strip("_") or "_"
        while word in taken:
            word += f"_{position}"
        taken.add(word)
        words.append(word)
    return words


def _exported_labels(
    model: SSP, start: Hashable, idle: IntArray, n_paying: int
) -> Mapping[str, IntArray]:
    """The labels of the model, and those that the files give a meaning."""
    goals = np.flatnonzero(model.goal_mask)
    labels = {
        INITIAL: np.array([_exported_start(model, start)]),
        DEADLOCK: idle[~model.goal_mask[idle]],
        GOAL: goals,
    }
    for name, members in model.state_labels.items():
        if name in labels or not name or _BAD_LABEL.search(name):
            raise ModelError(f"the label {name!r} cannot be written: give it another name")
        labels[name] = members
    own = np.arange(n_paying) + model.n_states
    if n_paying:
        labels[PAYING] = np.concatenate([labels.get(PAYING, own[:0]), own])
    return labels


def _exported_start(model: SSP, start: Hashable) -> int:
    """The number of the one state in which an exported model begins."""
    if isinstance(start, Mapping):
        raise ModelError("such files begin in one state: name it, or add one that draws the start")
    return model.index_of(start)


def write_text(path: FilePath, pieces: Iterable[str]) -> None:
    """Write pieces of exported text one after the other; gzip where the name ends in .gz."""
    place = Path(path)
    if place.suffix == ".gz":
        with gzip.open(place, "wt", _GZIP_LEVEL, encoding="utf-8", newline="\n") as packed:
            packed.writelines(pieces)
    else:
        with place.open("w", encoding="utf-8", newline="\n") as plain:
            plain.writelines(pieces)
