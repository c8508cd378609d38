"""Quantities that go on counting after failing, and the larger model that is needed for them.

After failing, costs are not counted, but the run goes on (mathematics, section 2). A quantity may
count events after a dead-end is entered or a policy gave up: an end, or steps or visits with
``through_failure``. Then the problem is restated on the product of the model with a failure label:
each state exists before and after failing. Otherwise the model is not changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ssp_lp.arrays import BoolArray, FloatArray, read_only, segment_minima
from ssp_lp.errors import ModelError
from ssp_lp.model import SSP, graph
from ssp_lp.model.failure_product import FailureSSP, label_failing
from ssp_lp.processes.conditions import ArrivalTerm, Condition, StepTerm, Term
from ssp_lp.processes.failure_semantics import (
    Aim,
    FailureSemantics,
    GiveUp,
    free_pairs,
    giving_up_states,
)
from ssp_lp.processes.live_rows import cost_means


def labelled_past_failing(
    model: SSP,
    limits: Sequence[Condition],
    objective: Condition | None,
    semantics: FailureSemantics,
    *,
    ratio: bool,
    discount: float | None,
) -> FailureSSP | None:
    """Return the product of a model with the failure label; None: no quantity needs it.

    Args:
        model: the model.
        limits: the limited quantities.
        objective: a quantity that is minimised instead of the cost.
        semantics: where a policy may give up, and the cost of failing.
        ratio: whether the objective is a cost given success.
        discount: the discount; None: no discount, so that infinite totals must be ruled out.
    """
    limits_and_objective = (*limits, *(() if objective is None else (objective,)))
    terms = [term for condition in limits_and_objective for _, term in condition.terms]
    if semantics.forbids_failing or not terms:
        return None
    ends, targets = _ends_past_failing(model, terms)
    pays = any(isinstance(term, StepTerm) and term.through for term in terms)
    if not (targets.any() or pays):
        return None

    # with accumulated cost, as in case S, a policy may give up at attention states
    dead = graph.dead_ends(model)
    give_up = GiveUp.ATTENTION if semantics.charge(ratio) is not None else semantics.give_up
    staying = graph.attention_pairs(model, graph.attention_states(model))
    usable = (dead & ~ends)[model.pair_state]
    if give_up is not GiveUp.DEAD_ENDS:
        usable |= staying & ~dead[model.pair_state]
    counts = np.zeros(model.n_pairs, dtype=np.bool_)  # at every use after failing
    for term in terms:
        if term.through:
            counts |= ~term.free
    leaving = usable & (counts | graph.pairs_into(model, targets))
    if not leaving.any():
        return None
    is_open = graph.nearer_pairs(model, leaving, usable) >= 0
    stops = giving_up_states(model, give_up) & ~is_open & ~dead
    charged = dead[model.pair_state]
    if give_up is not GiveUp.DEAD_ENDS:
        charged = charged | staying | (give_up is GiveUp.ANYWHERE)
    totals = semantics.charge(ratio) is not None
    free = np.ones((2, model.n_pairs), dtype=np.bool_)
    if counts.any() and discount is None:
        aim = Aim.LEAST_COST if totals else semantics.aim
        rows = [row for condition in limits for row in condition.rows]
        before = free_pairs(model, aim, rows, None if objective is None else objective.minimised())
        free = np.stack([before, ~counts])
    open_pairs = usable & is_open[model.pair_state]
    label = label_failing(model, open_pairs, stops, charged, free)
    charges = semantics.charge_failing_step and not totals
    return replace(label, charges=charges, costs=_costs_until_failing(label, model.costs, charges))


def check_counted_past_failing(
    model: SSP, limit: Condition, semantics: FailureSemantics, *, ratio: bool
) -> None:
    """Check that a process contains all events that a quantity counts, also those after failing.

    Args:
        model: the model of the process, perhaps a product with the failure label.
        limit: the quantity, looked up in the model before any product.
        semantics: where a policy may give up.
        ratio: whether the objective is a cost given success.

    Raises:
        ModelError: the process does not contain some event after failing.
    """
    # finiteness does not matter here: the discount skips that check
    needed = labelled_past_failing(limit.model, (), limit, semantics, ratio=ratio, discount=1.0)
    if (label := model.failure_label) is None:
        is_told = needed is None
    else:
        ends = _ends_past_failing(limit.model, [term for _, term in limit.terms])[0]
        is_told = bool(label.ended[: label.n_original][ends].all())
        if needed is not None:
            is_told &= not (needed.open_pairs & ~label.open_pairs).any()
    if is_told:
        return
    raise ModelError(
        "the quantity counts events after failing, which the program does not contain: also "
        "limit it in the problem's constraints, if only by a bound that is always satisfied"
    )


def _ends_past_failing(model: SSP, terms: Iterable[Term]) -> tuple[BoolArray, BoolArray]:
    """Return masks of the dead-ends that terms count as ends, and of all states that they count.

    The second mask adds the states whose visits count through failure. Both have the shape
    [states].
    """
    ends, targets = np.zeros((2, model.n_states), dtype=np.bool_)
    for term in terms:
        if isinstance(term, ArrivalTerm) and term.final:
            ends |= term.states & ~model.goal_mask
        elif isinstance(term, ArrivalTerm) and term.through:
            targets |= term.states
    return ends, targets | ends


def _costs_until_failing(label: FailureSSP, costs: FloatArray, charges: bool) -> FloatArray:
    """Return a cost on the product, [outcomes of the product]; it is 0 after failing.

    Args:
        label: the product.
        costs: cost of each outcome of the original model, [outcomes].
        charges: whether failing is charged the least expected cost of a step.
    """
    charge = np.zeros(label.n_original)
    if charges:
        means = cost_means(replace(label.original, costs=read_only(costs)))
        least = np.where(label.charged, means, np.inf)
        least = segment_minima(least, label.original.pair_offsets)
        charge = np.where(np.isfinite(least), least, 0.0)
    return read_only(label.spread_costs(costs, charge))


def past_failing_term(label: FailureSSP, term: Term) -> Term:
    """Translate a term from a model to its product with the failure label.

    Ends are the true ends, also after failing. Costs and visits count until failing; with
    ``through_failure`` they count to the true end.
    """
    if isinstance(term, StepTerm):
        costs = term.model.costs
        if term.model is label.original:
            return StepTerm(label)
        if term.through:
            nothing = np.zeros(label.n_original)
            counted = read_only(label.spread_costs(costs, nothing, through=True))
        else:
            counted = _costs_until_failing(label, costs, label.charges)
        return StepTerm(replace(label, costs=counted, exact_costs={}), term.through)
    later = term.states & ~label.original.goal_mask if term.final or term.through else False
    states = np.append(term.states, np.broadcast_to(later, label.n_original))
    return replace(term, model=label, states=states)
