"""Storm's multi-objective check (stormpy 2) on the augmented process.

    multi(R{"cost"}min=? [C], P<=budget [F "fail"])

The process gets two absorbing states, the goal and failure, so that every number has the meaning of
this library. (Asked for `P>=1-budget [F "goal"]` instead, Storm is as fast, but at its default
precision it answered 1.00005 to robot-80x36-M, where 13.5637 is right.)

Case S, a ratio, is beyond Storm: it minimises E[cost; goal] within the budget on the states x
accumulated cost. That is the ratio's numerator, and where the budget is tight, as on these
instances, its value over 1 - budget is the ratio. Our solvers compute the ratio itself.

Case P is `Pmax=? [F "goal"]`, case C `R{"cost"}min=? [F "goal"]`, by Storm's default method.
"""

from typing import Any

import numpy as np
import scipy.sparse as sp
import stormpy
from stormpy import datastructures, environments, models

from examples.solver_comparison.instances.models import ReadyInstance
from examples.solver_comparison.solvers.answer import Answer, Prepared, infeasible, joined
from examples.solver_comparison.solvers.catalogue import Order
from examples.solver_comparison.solvers.explicit import describe, size_of, written_out
from ssp_lp.processes.explicit_process import ExplicitProcess

_CHUNK = 20_000  # states handed over at a time: lists of Python numbers are large


def prepare(ready: ReadyInstance, order: Order, *, sound: bool, precision: str | None) -> Prepared:
    """Prepare to solve an instance with Storm.

    Args:
        ready: the instance.
        order: not used, as Storm has no time limit.
        sound: whether to use methods that bound their error, the default of stormpy; False:
            Storm's own defaults, which are faster.
        precision: absolute, as a fraction; None: Storm's default, 1e-4.
    """
    process = written_out(ready)
    model, size, details = storm_model(process), size_of(process), describe(process)
    del process
    asked = ready.instance
    formulas = {"P": 'Pmax=? [F "goal"]', "C": 'R{"cost"}min=? [F "goal"]'}
    formula = least_cost_within(asked.failure_budget)
    if asked.case in formulas:
        formula = stormpy.parse_properties(formulas[asked.case])[0]
    environment = environments.sound() if sound else environments.Environment()
    settings = environment.modelchecker().multi()
    if precision is not None:
        settings.precision = stormpy.Rational(precision)
    (start,) = model.initial_states

    def call() -> Answer:
        result = stormpy.model_checking(model, formula, environment=environment)
        if not hasattr(result, "get_value"):  # not a number but "no": the limit cannot be kept
            return infeasible(asked.case)
        value = float(result.get_value(start))
        if asked.case != "S":
            return Answer(value)
        success = 1.0 - asked.failure_budget
        return Answer(value / success, note="min E[cost; goal] / (1 - budget)")

    note = joined(f"precision {float(settings.precision):.0e}", size)
    return Prepared(call, note=note, details=details)


def least_cost_within(failure_budget: float) -> Any:
    """Return Storm's formula for the least expected cost within a failure budget."""
    query = f'multi(R{{"cost"}}min=? [C], P<={failure_budget!r} [F "fail"])'
    return stormpy.parse_properties(query)[0]


def storm_model(process: ExplicitProcess) -> models.SparseMdp:
    """Return a process as Storm's MDP: its states, then goal, failure and a source."""
    n, n_pairs = process.n_states, process.n_pairs
    whole = _with_ends(process)
    offsets = np.concatenate([process.pair_offsets, n_pairs + np.arange(1, 4)])
    labels = models.StateLabeling(n + 3)
    for label, state in (("goal", n), ("fail", n + 1), ("init", n + 2)):
        labels.add_label(label)
        labels.add_label_to_state(label, state)
    cost = models.SparseRewardModel[float](
        optional_state_action_reward_vector=[*process.cost.tolist(), 0.0, 0.0, 0.0]
    )
    parts = models.SparseModelComponents[float](
        transition_matrix=_storm_matrix(whole, offsets),
        state_labeling=labels,
        reward_models={"cost": cost},
    )
    return models.SparseMdp[float](parts)


def _with_ends(process: ExplicitProcess) -> sp.csr_array:
    """Return the transitions with the ends, and a source whose one step leads to the start."""
    n = process.n_states
    body = sp.hstack([process.transitions, process.goal[:, None], process.failure[:, None]])
    source = np.concatenate([process.start, [0.0, 0.0]])[None, :]
    rows = [sp.csr_array(body), sp.eye_array(2, n + 2, k=n), sp.csr_array(source)]
    whole = sp.csr_array(sp.vstack(rows, format="csr"))
    whole.eliminate_zeros()
    whole.sort_indices()
    return whole


def _storm_matrix(whole: sp.csr_array, offsets: np.ndarray) -> datastructures.SparseMatrix:
    n_states = len(offsets) - 1
    builder = datastructures.SparseMatrixBuilder[float](
        rows=whole.shape[0],
        columns=n_states,
        entries=whole.nnz,
        has_custom_row_grouping=True,
        row_groups=n_states,
    )
    for first in range(0, n_states, _CHUNK):
        states = offsets[first : min(first + _CHUNK, n_states) + 1]
        ends = whole.indptr[states[0] : states[-1] + 1]
        rows = np.repeat(np.arange(states[0], states[-1]), np.diff(ends))
        entries = slice(ends[0], ends[-1])
        builder.add_next_values(
            rows.tolist(),
            whole.indices[entries].tolist(),
            whole.data[entries].tolist(),
            states[:-1].tolist(),
        )
    return builder.build()
