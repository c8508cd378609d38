"""A process written out for the search for one deterministic policy, and the way back from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from ssp_lp.arrays import BoolArray, IntArray
from ssp_lp.column_generation.compiled_problems.compiled_accumulated_cost import (
    CompiledAccumulatedCost,
)
from ssp_lp.column_generation.compiled_problems.compiled_failure_label import CompiledFailureLabel
from ssp_lp.column_generation.compiled_problems.compiled_problem import CompiledProblem
from ssp_lp.column_generation.pricing.pricing_problem import Column
from ssp_lp.errors import Argument, ModelError
from ssp_lp.processes.explicit import ExplicitProcess
from ssp_lp.processes.layered.layered_process import LayeredProcess
from ssp_lp.processes.quotient import Quotient

_MOST_PAIRS = 500_000
_METHOD = Argument("method", "deterministic")
_ENDLESS = 1e9  # price of failure, relative to 1 + the optimal one, by which no tail fails at will


@dataclass(frozen=True, eq=False)
class ProcessView:
    """The process that policies live on, and one of which they are special cases.

    A deterministic policy may leave a collapsed component by a way that depends on where it came
    in, and may go on beyond the cap of case S by other policies than the tails. In ``outer`` this
    is allowed for: states that are ``free`` randomise, and beyond the cap success costs no more
    than what had been paid at its border, with any probability that some policy attains.
    """

    compiled: CompiledProblem
    process: ExplicitProcess
    outer: ExplicitProcess
    free: BoolArray  # [states] those within reach of the start
    safe: IntArray  # [states] pairs of a policy that leaves from every state
    measure: Callable[[IntArray], list[Column]]  # a choice to policies, each measured exactly


def process_view(compiled: CompiledProblem, price: float) -> ProcessView:
    """Write a process out.

    Args:
        compiled: of case M or S.
        price: of failure at the best lottery.

    Raises:
        ModelError: a problem of another kind, or one with too many pairs.
    """
    here = compiled.for_program()
    if isinstance(here, CompiledFailureLabel):
        return _view_of_case_m(here, price)
    if isinstance(here, CompiledAccumulatedCost):
        return _view_of_case_s(here, price)
    raise ModelError(_METHOD, f" does not know {type(compiled).__name__}")


def _view_of_case_m(compiled: CompiledFailureLabel, price: float) -> ProcessView:
    """The view of a process in case M."""
    pricing = compiled.pricing()
    process = pricing.process
    _check_view_size(process.n_pairs)
    best = pricing.minimise(price)
    free = np.zeros(process.n_states, dtype=np.bool_)
    merged = _merged_nodes(compiled.labelled.quotient)
    free[: len(merged)] = merged
    return ProcessView(
        compiled=compiled,
        process=process,
        outer=process,
        free=free & within_reach(steps_between(process), process.start > 0),
        safe=compiled.explicit_choice(best),
        measure=lambda choice: [pricing.measure(choice.astype(np.int32))],
    )


def _view_of_case_s(compiled: CompiledAccumulatedCost, price: float) -> ProcessView:
    """The view of a process in case S, layer by layer."""
    layered, pricing = compiled.process, compiled.pricing()
    base, cap = layered.base, layered.cap
    _check_view_size(cap * len(base.gain))
    process = compiled.explicit()
    beyond = np.arange((base.width - 1) * base.n_nodes) + cap * base.n_nodes
    free = np.zeros(process.n_states, dtype=np.bool_)
    free[: cap * base.n_nodes] = np.tile(_merged_nodes(base.quotient), cap)
    free[beyond] = True
    prices = (price, 0.0, _ENDLESS * (1.0 + price))

    def measure(choice: IntArray) -> list[Column]:
        """A choice followed by the tails of each price, measured."""
        within = choice[: cap * base.n_nodes].reshape(cap, base.n_nodes)
        shift = np.arange(cap)[:, None] * len(base.gain) + base.pair_offsets[:-1]
        return [pricing.measure((within - shift).astype(np.int32), tail) for tail in prices]

    return ProcessView(
        compiled=compiled,
        process=process,
        outer=_view_with_loose_tails(process, layered, beyond),
        free=free & within_reach(steps_between(process), process.start > 0),
        safe=compiled.explicit_choice(pricing.minimise(price)),
        measure=measure,
    )


def _view_with_loose_tails(
    process: ExplicitProcess, layered: LayeredProcess, beyond: IntArray
) -> ExplicitProcess:
    """Replace the tails by the greatest and the least success, which cost what has been paid.

    Every success from accumulated cost r on costs at least ``r * E[gamma^(T-1); goal]``, and its
    probability lies between the two: their mixtures are no dearer than any policy.
    """
    base, tails = layered.base, layered.tails
    n_layers = base.width - 1
    first = process.pair_offsets[beyond]
    last = process.pair_offsets[beyond + 1] - 1
    paid = np.repeat(layered.cap + np.arange(n_layers), base.n_nodes) * base.unit / base.survival
    cost, goal, failure = process.cost.copy(), process.goal.copy(), process.failure.copy()
    for pairs, success in ((first, tails.greatest_goal), (last, tails.least_goal)):
        share = np.tile(np.clip(success, 0.0, 1.0), n_layers)
        cost[pairs], goal[pairs], failure[pairs] = paid * share, share, 1.0 - share
    return replace(process, cost=cost, goal=goal, failure=failure)


def _merged_nodes(quotient: Quotient) -> BoolArray:
    """Nodes of the process viewed that stand for a component of several states, [nodes]."""
    members = np.bincount(quotient.node_of[quotient.merged], minlength=quotient.n_nodes)
    return np.asarray(members > 1)


def _check_view_size(n_pairs: int) -> None:
    """Raise :class:`ModelError` where the view of a process is too large for an integer program."""
    if n_pairs > _MOST_PAIRS:
        raise ModelError(
            _METHOD,
            f": a mixed-integer program of {n_pairs:,} pairs is too large (at most "
            f"{_MOST_PAIRS:,}); a coarser grid of costs or a lower ",
            Argument("cost_cap"),
            " makes it less",
        )


def within_reach(steps: sp.csr_array, start: BoolArray) -> BoolArray:
    """States of a process viewed to which a path leads, the first ones included, [states]."""
    n = len(start)
    first = sp.csr_array(start.astype(np.float64)[None, :])
    below = sp.vstack([steps, first])
    graph = sp.csr_array(sp.hstack([below, sp.csr_array((n + 1, 1))]))
    order = csgraph.breadth_first_order(graph, n, return_predecessors=False)
    reached = np.zeros(n + 1, dtype=np.bool_)
    reached[order] = True
    return reached[:n]


def steps_between(process: ExplicitProcess) -> sp.csr_array:
    """Steps between states of a process viewed, by whatever pair, [states, states]."""
    of_state = sp.csr_array(
        (np.ones(process.n_pairs), np.arange(process.n_pairs), process.pair_offsets),
        shape=(process.n_states, process.n_pairs),
    )
    graph = sp.csr_array(of_state @ process.transitions)
    graph.eliminate_zeros()
    return graph
