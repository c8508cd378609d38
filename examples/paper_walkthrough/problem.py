"""Section 2 of the paper on the journey: model, policies, dead-ends, objectives, constraint."""

from fractions import Fraction

import numpy as np

from examples.paper_walkthrough.model import (
    FOR_EVER,
    START,
    Plan,
    Row,
    cost,
    failure,
    journey,
    stationary_policy,
)
from ssp_lp import GIVE_UP, MCMP, S3P, MixedPolicy, StochasticPolicy, evaluate, solve
from ssp_lp.model.graph import attention_states, dead_ends
from ssp_lp.processes.goal_reach import max_goal_probability, min_goal_probability
from ssp_lp.processes.live_rows import cost_means, successor_means

GOING, STAYING = Plan(True, FOR_EVER), Plan(True, 0)
GAMMAS = tuple(1 - Fraction(1, 10**k) for k in (1, 2, 4, 6))


def section_2_1() -> list[Row]:
    """Check the model: states, actions, outcomes; g may depend on the outcome."""
    model = journey()
    stage = {str(model.action_of(k)): g for k, g in enumerate(cost_means(model))}
    hits = successor_means(model, model.goal_mask)
    arrives = {str(model.action_of(k)): p for k, p in enumerate(hits)}
    return [
        Row("states", model.n_states, 6),
        Row("state-action pairs", model.n_pairs, 7),
        Row("E[g] of crossing, go", stage["go"], 4),
        Row("Pr(home) of crossing, go", arrives["go"], Fraction(1, 2)),
        Row("Pr(home) of bank, ford", arrives["ford"], Fraction(9, 10)),
    ]


def section_2_2() -> list[Row]:
    """Compare a lottery drawn at the start with an equivalent randomised policy."""
    model = journey()
    problem = MCMP(model, start=START, failure_budget=0.1)
    members = tuple(stationary_policy(model, p) for p in (GOING, STAYING))
    mixed = evaluate(MixedPolicy(members, np.array([0.9, 0.1])), problem)
    # The lottery is at the crossing 2 * 9/10 + 1/10 = 19/10 times for each arrival there, and
    # gives up in 1/10 of them: 1 in 19.
    equivalent = StochasticPolicy.from_actions(
        model,
        {
            "depot": {"drive": 1.0},
            "bank": {"ford": 1.0},
            "crossing": {"go": 18 / 19, GIVE_UP: 1 / 19},
        },
    )
    drawn = evaluate(equivalent, problem)
    expected = Fraction(9, 10) * cost(GOING) + Fraction(1, 10) * cost(STAYING)
    return [
        Row("lottery 9/10, 1/10: E[r_tau]", mixed.expected_cost, expected),
        Row("lottery: failure", mixed.failure_probability, Fraction(1, 10)),
        Row("randomised, 1/19 to give up: E[r_tau]", drawn.expected_cost, expected),
        Row("randomised: failure", drawn.failure_probability, Fraction(1, 10)),
    ]


def section_2_3() -> list[Row]:
    """Check MAXPROB and MINPROB, whose zeros are the dead-ends and the attention states."""
    model = journey()
    most, least = max_goal_probability(model), min_goal_probability(model)
    dead, attention = dead_ends(model), attention_states(model)
    greatest: dict[str, Fraction | int] = {
        "depot": Fraction(99, 100),
        "bank": Fraction(49, 50),
        "crossing": 1,
        "wreck": 0,
    }
    smallest: dict[str, Fraction | int] = {
        "depot": Fraction(9, 20),
        "bank": Fraction(9, 10),
        "crossing": 0,
        "wreck": 0,
    }
    rows = []
    for state, value in greatest.items():
        s = model.index_of(state)
        rows += [
            Row(f"MAXPROB from the {state}", most[s], value),
            Row(f"MINPROB from the {state}", least[s], smallest[state]),
            Row(f"{state} is a dead-end", dead[s], float(value == 0)),
            Row(f"{state} is an attention state", attention[s], float(smallest[state] == 0)),
        ]
    return rows


def section_2_4() -> list[Row]:
    """Check objectives with least failure (MCMP and S3P themselves) and for one policy.

    The sum over t in the definition of J_MCMP is a slip: J_MCMP = E[r_tau]. By that definition the
    step that fails is not paid; by the construction of section 3.1.2 it is paid once.
    """
    model = journey()
    unpaid = MCMP(model, start=START, failure_budget=1.0, charge_failing_step=False)
    policy = stationary_policy(model, STAYING)
    paid = evaluate(policy, MCMP(model, start=START, failure_budget=1.0))
    return [
        # 1 + (2 + 2 + 1/50) / 2 + 8 / 2, over the bridge and going for ever.
        Row("MCMP at least failure", solve(MCMP(model, start=START)).objective,
            Fraction(701, 100)),
        # (5 * 49/50 + 9) / 2, given that home is reached, in 99 of 100 runs.
        Row("S3P at least failure", solve(S3P(model, start=START)).objective, Fraction(695, 99)),
        Row("ford, give up: E[r_tau], failing paid", paid.expected_cost, Fraction(41, 20)),
        Row("failing not paid", evaluate(policy, unpaid).expected_cost, Fraction(3, 2)),
        Row("cost given home", paid.conditional_cost, Fraction(2)),
    ]  # fmt: skip


def section_2_5() -> list[Row]:
    """Check the constraint: an average cost (t2-0), its discounted form (t2-1), a bound (t2-2).

    t2-0: a run that gets home by the time T adds T / horizon, others add 1; E[T; home] = 12/5.
    """
    model, horizon = journey(), 1000
    policy = stationary_policy(model, GOING)
    rows = [Row(f"t2-0: mean of h_d up to {horizon}", _mean_away(horizon),
                Fraction(1, 20) + Fraction(12, 5) / horizon)]  # fmt: skip
    for gamma in GAMMAS:
        problem = MCMP(model, start=START, failure_budget=0.1, discount=float(gamma))
        found = evaluate(policy, problem)
        surrogate = found.discounted_failure or 0.0
        near = f"1 - {float(1 - gamma):g}"
        rows.append(Row(f"L_d at gamma = {near}", surrogate, failure(GOING, gamma)))
        # Pr(never home) <= L_d, and L_d <= Pr(never home) + (1 - gamma) E[T; home] (Bernoulli).
        rows.append(Row("t2-1, t2-2: its distance to 1/20", surrogate, Fraction(1, 20),
                        bound=float((1 - gamma) * Fraction(12, 5))))  # fmt: skip
        rows.append(Row("t2-2: L_d is the larger one",
                        float(surrogate >= found.failure_probability), 1))  # fmt: skip
    return rows


def _mean_away(horizon: int) -> float:
    """Compute E[sum of h_d(x_t)] / horizon of fording and going, step by step."""
    # depot, bank, crossing, wreck; home is left out.
    step = np.array([[0, 0.5, 0.5, 0], [0, 0, 0, 0.1], [0, 0, 0.5, 0], [0, 0, 0, 1]])
    where, away = np.array([1.0, 0.0, 0.0, 0.0]), 0.0
    for _ in range(horizon):
        away += where.sum()
        where = where @ step
    return away / horizon
