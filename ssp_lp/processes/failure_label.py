"""The failure label {s, f} of case M (paper, section 3.1.2) as a substochastic process.

Label s means that the run has not failed, label f that it has. States with label f cost nothing
more and never reach the goal. They are left out: a pair that gives up removes its mass as failure.
Only the states with label s remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from ssp_lp.arrays import BoolArray, FloatArray, IntArray
from ssp_lp.compiled.deadline import check_time
from ssp_lp.model import SSP
from ssp_lp.model.graph import pairs_into, surely_reaching
from ssp_lp.policies.policy import DeterministicPolicy
from ssp_lp.processes.conditions import UpperRow
from ssp_lp.processes.explicit_process import ExplicitProcess
from ssp_lp.processes.failure_semantics import (
    Aim,
    Counting,
    FailureSemantics,
    free_pairs,
    giving_up_states,
    stage_costs,
    survival_of,
)
from ssp_lp.processes.live_rows import successor_means
from ssp_lp.processes.quotient import Quotient, build_quotient


@dataclass(frozen=True, eq=False)
class LabelledProcess:
    """The process of case M, and the translation of its policies to the model."""

    process: ExplicitProcess
    quotient: Quotient
    escape: FloatArray  # [quotient pairs] divisors of the rows (see ``live_rows``)

    @property
    def own_cost(self) -> FloatArray:
        """The minimised cost, [process pairs]."""
        return self.process.cost

    def policy(self, choice: IntArray) -> DeterministicPolicy:
        """Translate a choice in the process to a policy on the model.

        Args:
            choice: pair of the process, [states].
        """
        decision = self.quotient.pull_back(choice[: self.quotient.n_nodes])
        return DeterministicPolicy(self.quotient.model, decision)

    def nearer_goal(self, *, safely: bool = False) -> IntArray | None:
        """Return a pair of each state on a shortest way to the goal, [states]; -1: no way.

        The result is None if components of the model are merged in the process: then the search
        must run on the process itself (see ``Quotient.nearer``).

        Args:
            safely: whether to prefer ways whose pairs cannot lead to a dead-end.
        """
        model = self.quotient.model
        nearer = self.quotient.nearer_goal()
        if safely and nearer is not None:
            safe = ~pairs_into(model, self.quotient.dead)
            guarded = self.quotient.nearer_goal(safe)
            nearer = nearer if guarded is None else np.where(guarded >= 0, guarded, nearer)
        return None if nearer is None else self._with_source(nearer)

    def placed(self, decision: IntArray) -> IntArray | None:
        """Translate a policy of the model to a policy of the process, [states].

        The result is None if the process merges components, or lacks a pair of the policy.

        Args:
            decision: pair of the model, negative for none, [model states].
        """
        if self.quotient.merged.any():
            return None
        choice = self.quotient.placed(decision)
        return None if (choice < 0).any() else self._with_source(choice).astype(np.int32)

    def _with_source(self, choice: IntArray) -> IntArray:
        """Append the only pair of the source state to a choice, if the process has a source."""
        if self.process.n_states == len(choice):
            return choice
        return np.append(choice, self.process.n_pairs - 1)


def label_failure(
    model: SSP,
    start: FloatArray,
    semantics: FailureSemantics,
    discount: float | None = None,
    usable: BoolArray | None = None,
    side: Sequence[UpperRow] = (),
    objective: UpperRow | None = None,
    quotient: Quotient | None = None,
) -> LabelledProcess:
    """Build the process of case M: the states with the failure label.

    Args:
        model: the model.
        start: distribution over states, [states].
        semantics: where giving up is allowed, and the costs of failing. If failing is forbidden,
            only pairs from which the goal stays sure are kept.
        discount: factor of every transition; the mass that is lost in a non-goal state counts as
            failure (paper, section 3.5). None: no discount.
        usable: pairs that may be used, [pairs], in the second stage of a least-failure problem
            (mathematics, section 4): a policy may then neither give up nor stay for ever in a free
            end component. None: all pairs, without these restrictions.
        side: further limits.
        objective: a quantity that is minimised instead of the aim of the semantics.
        quotient: the live part of the model, with the pairs that give up; None: built here.
    """
    if quotient is None:
        free = None if discount is not None else free_pairs(model, semantics.aim, side, objective)
        unsure = None
        if semantics.forbids_failing:
            sure, keeping, _ = surely_reaching(model)
            usable, unsure = keeping if usable is None else usable & keeping, ~sure
        exits = giving_up_states(model, semantics.give_up, usable)
        quotient = build_quotient(
            model, usable=usable, free=free, exits=exits, free_exits=usable is None, ended=unsure
        )
    survival = survival_of(discount)
    stage, entering = stage_costs(model, quotient, semantics, survival)
    to_dead = quotient.at_pairs(successor_means(model, quotient.dead), 1.0)
    to_goal = quotient.at_pairs(successor_means(model, model.goal_mask))
    leaks = np.where(quotient.pair_at >= 0, (1.0 - survival) + survival * to_dead, 1.0)
    rows = quotient.transitions(survival, departing=survival == 1.0)
    escape = rows.escape
    process = ExplicitProcess(
        pair_offsets=quotient.pair_offsets,
        transitions=rows.matrix,
        start=quotient.gather(start),
        cost=stage / escape,
        failure=leaks / escape,
        goal=survival * to_goal / escape,
    )
    check_time()
    process = with_start(process, quotient, start, float(start @ entering))
    if semantics.aim is Aim.GREATEST_GOAL:
        process = replace(process, cost=process.failure)
    elif semantics.aim is Aim.LEAST_GOAL:
        process = replace(process, cost=process.goal)
    elif semantics.penalty > 0.0 and not semantics.forbids_failing:
        process = replace(process, cost=process.cost + semantics.penalty * process.failure)
    return LabelledProcess(process, quotient, escape)


def counting_of(
    labelled: LabelledProcess,
    start: FloatArray,
    semantics: FailureSemantics,
    discount: float | None = None,
) -> Counting:
    """Return the object that computes the coefficients of quantities on a process of case M.

    Args:
        labelled: the process. Pairs inside its merged components must add nothing to any quantity.
        start: distribution over states, [states].
        semantics: semantics of the process.
        discount: discount of the process.
    """
    process, n_pairs = labelled.process, len(labelled.escape)
    ends = process.goal[:n_pairs], process.failure[:n_pairs]
    survival = survival_of(discount)
    return Counting(labelled.quotient, labelled.escape, *ends, start, semantics, survival)


def with_start(
    process: ExplicitProcess, quotient: Quotient, start: FloatArray, cost: float
) -> ExplicitProcess:
    """Return a process that begins in its states alone, by a source state if need be.

    If some start mass lies on goals or dead-ends, a source state is added: its only pair leads to
    the start states, to the goal and to failure.

    Args:
        process: the process, with the start mass on its states.
        quotient: nodes and pairs of the process.
        start: distribution over states of the model, [states].
        cost: cost of the pair of the source.
    """
    at_goal = float(start[quotient.model.goal_mask].sum())
    at_dead = float(start[quotient.dead].sum())
    if at_goal + at_dead == 0.0:
        return process
    n = quotient.n_nodes
    source_row = sp.csr_array(np.append(process.start, 0.0)[None, :])
    wider = sp.csr_array(
        (process.transitions.data, process.transitions.indices, process.transitions.indptr),
        shape=(process.n_pairs, n + 1),
    )
    return ExplicitProcess(
        pair_offsets=np.append(process.pair_offsets, process.n_pairs + 1),
        transitions=sp.csr_array(sp.vstack([wider, source_row])),
        start=np.concatenate([np.zeros(n), [1.0]]),
        cost=np.append(process.cost, cost),
        failure=np.append(process.failure, at_dead),
        goal=np.append(process.goal, at_goal),
    )
