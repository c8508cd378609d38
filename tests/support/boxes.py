"""Small models with boxes, the models at the corners of these, and all policies."""

from dataclasses import replace
from itertools import permutations, product

import numpy as np

from ssp_lp import SSP, Boxes, DeterministicPolicy
from ssp_lp.model.graph import attention_states
from ssp_lp.policies.policy import GIVE_UP_CODE


def drawn_boxes(rng, *, n_states=3, zeros=False, labels=None, most_actions=2, even=False):
    """Boxes of a random model on states "a", "b", ... with "home" and "pit".

    Args:
        rng: draws.
        n_states: that have actions.
        zeros: whether intervals may begin at 0, so that nature can rule outcomes out.
        labels: of states.
        most_actions: of a state.
        even: whether an action costs the same whatever comes of it.
    """
    states = [*"abcdef"[:n_states]]
    transitions = {}
    for state in states:
        transitions[state] = {}
        for action in range(int(rng.integers(1, most_actions + 1))):
            width = int(rng.integers(1, 4))
            others = [*states, "home", "pit"]
            to = [others[k] for k in rng.permutation(len(others))[:width]]
            shares = rng.dirichlet(np.ones(width))
            costs = rng.integers(0, 4, 1 if even else width).tolist() * (width if even else 1)
            transitions[state][action] = [*zip(shares, to, map(float, costs), strict=True)]
    transitions["pit"] = {}
    model = SSP.from_transitions(transitions, {"home"}, state_labels=labels,
                                 treat_actionless_as_dead_ends=True)  # fmt: skip
    p = model.probabilities
    low = p * rng.uniform(0.2, 1.0, p.size)
    if zeros:
        low[rng.random(p.size) < 0.5] = 0.0
    high = np.minimum(p + rng.uniform(0.0, 0.4, p.size), 1.0)
    return Boxes(model, low, high)


def corners_of(boxes, pairs):
    """Models at all corners of the boxes of some pairs, other pairs as they are."""
    model, each = boxes.model, []
    for pair in pairs:
        part = slice(model.outcome_offsets[pair], model.outcome_offsets[pair + 1])
        low, high = boxes.low[part], boxes.high[part]
        found = {}
        for order in permutations(range(len(low))):
            p, rest = low.copy(), 1.0 - low.sum()
            for k in order:
                given = min(rest, high[k] - low[k])
                p[k], rest = p[k] + given, rest - given
            found[tuple(p.round(12))] = p
        each.append((part, [*found.values()]))
    for choice in product(*(corners for _, corners in each)):
        probabilities = model.probabilities.copy()
        for (part, _), p in zip(each, choice, strict=True):
            probabilities[part] = p
        yield replace(model, probabilities=probabilities)


def policies_of(model, *, may_give_up):
    """Every deterministic policy."""
    each = []
    for state in range(model.n_states):
        pairs = [*model.pairs_of(state)]
        each.append([*pairs, *[GIVE_UP_CODE] * may_give_up] if pairs else [-1])
    for decision in product(*each):
        yield DeterministicPolicy(model, np.array(decision))


def stopping_policies(model):
    """Every deterministic policy that gives up at attention states only."""
    going_on = ~attention_states(model) & (np.diff(model.pair_offsets) > 0)
    for policy in policies_of(model, may_give_up=True):
        if not (policy.decision[going_on] == GIVE_UP_CODE).any():
            yield policy
