"""Policies that act everywhere, and at many levels of cost."""

from __future__ import annotations

import numpy as np
import pytest

from cases import NAMES, expected, published
from formulations import MCMP, S3P, LeastQuantity, MaxProb
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    ModelError,
    acting_everywhere,
    end_probability,
    evaluate,
    expected_cost,
    simulate,
    solve,
    visits,
)
from ssp_lp.compiled.deadline import Stop
from ssp_lp.io import load_policy, save_policy
from ssp_lp.methods import refinement, rows
from ssp_lp.model.graph import attention_states, dead_ends
from ssp_lp.options import SolveOptions
from ssp_lp.policies import chain
from ssp_lp.processes.failure_semantics import start_distribution

# Policies that act in every state: as planned where they plan, sensibly elsewhere.


LARGE = 1_000

WITH_GOALS = [name for name in NAMES if name != "qcomp23_rov_B10"]  # a query of total rewards

COSTS = {case["model"]: case["cost"] for case in expected()["cases"]}

FORK = SSP.from_transitions(
    {
        "a": {"over": [(0.9, "home", 1.0), (0.1, "edge", 1.0)], "round": [(1.0, "home", 10.0)]},
        "edge": {"slide": [(1.0, "wreck", 1.0)], "climb": [(1.0, "home", 100.0)]},
        "wreck": {"wait": [(1.0, "wreck", 1.0)], "call": [(1.0, "grave", 1.0)]},
        "grave": {},
        "far": {"fly": [(0.5, "home", 1.0), (0.5, "grave", 1.0)], "walk": [(1.0, "a", 3.0)]},
    },
    {"home"},
    state_labels={"crash": ["grave"]},
    treat_actionless_as_dead_ends=True,
)


def asked_everywhere(policy) -> dict[object, set[object]]:
    """The first action of each member in each state, an episode begun there."""
    model, found = policy.model, {}
    for member in policy.policies:
        for state, action in zip(
            model.states,
            member.start_many(model.n_states, 0).actions(model.states),
            strict=True,
        ):
            found.setdefault(state, set()).add(action)
    return found


@pytest.mark.parametrize("name", WITH_GOALS)
@pytest.mark.parametrize("criterion", ["MCMP", "least", "S3P", "horizon"])
def test_every_state_of_every_published_model(name: str, criterion: str) -> None:
    """An action in every state that has one, as planned where that decides; worth the same."""
    model, start = published(name, COSTS.get(name, "unit"))
    if model.n_states > LARGE and criterion in {"S3P", "horizon"}:
        pytest.skip("by totals and by steps in smaller models")
    least = MaxProb(model, start)
    budget = min(solve(least).failure_probability + 0.1, 1.0)
    problem = {
        "MCMP": MCMP(model, start, budget),
        "least": MCMP(model, start),
        "S3P": S3P(model, start, budget),
        "horizon": MaxProb(model, start, horizon=5 if model.n_states < 200 else 2),
    }[criterion]
    if criterion == "horizon" and not problem.unrolled.model.goal_mask.any():
        return
    solution = solve(problem)
    policy = solution.policy_everywhere()
    acts = (np.diff(model.pair_offsets) > 0) & ~model.goal_mask
    for k, (state, actions) in enumerate(asked_everywhere(policy).items()):
        assert (actions != {None}) == acts[k], state
        assert None not in actions or not acts[k]
        assert GIVE_UP not in actions
    for member, complete in zip(solution.policy.policies, policy.policies, strict=True):
        states = np.flatnonzero(member.begins(np.arange(model.n_states)) & ~member.ended)
        planned = member.branches(states, member.start_memory(states))
        acting = complete.branches(states, complete.start_memory(states))
        decided = planned.pair >= -1
        gives_up = acting.gives_up(complete.start_memory(states))
        assert (planned.pair == np.where(gives_up, -1, acting.pair))[decided].all()
        assert (acting.pair != -2).all()
    found = evaluate(policy, problem)
    assert found.objective == pytest.approx(solution.evaluation.objective, rel=1e-9, abs=1e-12)
    assert found.ends == pytest.approx(solution.evaluation.ends, abs=1e-12)


def test_what_is_done_where() -> None:
    """As planned, at the price where nothing was planned, avoiding the goal after giving up."""
    problem = MCMP(FORK, "a", 0.1, charge_failing_step=False)
    solution = solve(problem)
    assert solution.policy.start(0).action("far") == "walk"
    policy = solution.policy_everywhere()
    found = asked_everywhere(policy)
    assert found["edge"] == {"slide"}
    assert found["far"] == {"walk"}
    assert found["wreck"] == {"wait"}
    assert found["grave"] == found["home"] == {None}
    assert asked_everywhere(solution.policy_everywhere(default="call"))["wreck"] == {"call"}
    assert asked_everywhere(solution.policy_everywhere({"wreck": "call"}))["wreck"] == {"call"}
    quits = DeterministicPolicy.from_actions(FORK, {"a": "over", "edge": GIVE_UP})
    fly = DeterministicPolicy.from_actions(FORK, {"far": "fly", "edge": "climb"})
    chosen = asked_everywhere(acting_everywhere(quits, fly))
    assert (chosen["far"], chosen["edge"], chosen["a"]) == ({"fly"}, {"climb"}, {"over"})
    with pytest.raises(ModelError, match="default"):
        acting_everywhere(quits, "swim")
    with pytest.raises(ModelError, match="another model"):
        acting_everywhere(quits, DeterministicPolicy.from_actions(MOVED, {}))


MOVED = SSP.from_transitions({"a": {"go": [(1.0, "home", 1.0)]}}, {"home"})


def test_an_episode_goes_on_to_its_true_end() -> None:
    quits = DeterministicPolicy.from_actions(FORK, {"a": "over", "edge": GIVE_UP})
    episode = acting_everywhere(quits, {"wreck": "call"}).start(0)
    assert episode.action("a") == "over"
    assert not episode.failed
    episode.observe("edge", 1.0)
    assert episode.action("edge") == "slide"
    assert episode.failed
    episode.observe("wreck", 1.0)
    assert episode.action("wreck") == "call"
    episode.observe("grave", 1.0)
    assert episode.action("grave") is None


def test_who_gave_up_does_not_come_back() -> None:
    """In the attention set the plan would drive on again; whoever gave up stays away."""
    moves = {
        "a": {"go": [(0.5, "home", 1.0), (0.5, "b", 1.0)], "wait": [(1.0, "b", 1.0)]},
        "b": {"go": [(1.0, "home", 5.0)], "back": [(1.0, "a", 1.0)]},
    }
    model = SSP.from_transitions(moves, {"home"})
    assert attention_states(model).sum() == 2
    quits = DeterministicPolicy.from_actions(model, {"a": "go", "b": GIVE_UP})
    episode = acting_everywhere(quits).start(0)
    for state, action in (("a", "go"), ("b", "back"), ("a", "wait"), ("b", "back")):
        assert episode.action(state) == action
        episode.observe({"go": "b", "back": "a", "wait": "b"}[action], 1.0)
    problem = MCMP(model, "a", 1.0)
    for policy in (quits, acting_everywhere(quits)):
        assert evaluate(policy, problem).failure_probability == pytest.approx(0.5)
        assert simulate(policy, problem, episodes=100, seed=0).ends["gave_up"] > 20


@pytest.mark.parametrize("horizon", [None, 6])
def test_what_counts_after_failing_comes_first(horizon, tmp_path) -> None:
    """The program's own decisions after failing, the others where it has none; from files, too."""
    limits = {"crash": end_probability("crash") <= 0.02}
    problem = MCMP(FORK, "a", 0.1, constraints=limits, horizon=horizon)
    solution = solve(problem)
    policy = solution.policy_everywhere()
    assert evaluate(policy, problem).secondary_costs["crash"] == pytest.approx(
        solution.secondary_costs["crash"], abs=1e-12
    )
    found = asked_everywhere(policy)
    assert found["wreck"] <= {"wait", "call"}
    save_policy(policy, tmp_path / "policy.npz")
    again = load_policy(tmp_path / "policy.npz", FORK)
    assert asked_everywhere(again) == found
    assert evaluate(again, problem).objective == pytest.approx(solution.objective, rel=1e-9)


BRAKES = SSP.from_transitions(
    {
        "a": {"over": [(0.9, "home", 1.0), (0.1, "edge", 1.0)], "round": [(1.0, "home", 10.0)]},
        "edge": {
            "slide": [(1.0, "wreck", 1.0)],
            "brake": [(0.3, "wreck", 1.0), (0.7, "ledge", 1.0)],
            "climb": [(1.0, "home", 100.0)],
        },
        "ledge": {
            "jump": [(1.0, "wreck", 0.0)],
            "wait": [(0.5, "ledge", 1.0), (0.5, "cave", 1.0)],
        },
        "wreck": {"burn": [(1.0, "ash", 0.0)], "roll": [(0.5, "ash", 1.0), (0.5, "cave", 1.0)]},
        "cave": {},
        "ash": {},
    },
    {"home"},
    state_labels={"fire": ["ash"]},
    treat_actionless_as_dead_ends=True,
)


def test_the_least_harm_after_failing() -> None:
    """The plan as it is, then the least fire: 0.1 give up, of which 0.3 crash and half burn."""
    problem = MCMP(BRAKES, "a", 0.1, charge_failing_step=False)
    solution = solve(problem)
    fire = end_probability("fire")
    watched = MCMP(BRAKES, "a", 0.1, charge_failing_step=False, constraints={"fire": fire <= 1.0})
    careful = solution.policy_everywhere(least_after=fire)
    found = evaluate(careful, watched)
    assert found.secondary_costs["fire"] == pytest.approx(0.015, rel=1e-12)
    assert found.objective == pytest.approx(solution.objective, rel=1e-12)
    cheap = {"cost": expected_cost() <= solution.objective}
    other = LeastQuantity(BRAKES, "a", fire, 0.1, constraints=cheap, charge_failing_step=False)
    assert solve(other).objective == pytest.approx(0.015, rel=1e-9)
    chosen = asked_everywhere(solution.policy_everywhere(least_after=fire))
    assert (chosen["edge"], chosen["wreck"], chosen["ledge"]) == ({"brake"}, {"roll"}, {"wait"})
    careless = evaluate(solution.policy_everywhere(), watched)
    assert careless.secondary_costs["fire"] == pytest.approx(0.1, rel=1e-12)  # slide, and burn
    seen = visits("wreck", through_failure=True)
    assert asked_everywhere(solution.policy_everywhere(least_after=seen))["edge"] == {"brake"}
    with pytest.raises(ModelError, match="through_failure"):
        solution.policy_everywhere(least_after=visits("a"))


def test_tables_tell_what_is_done_afterwards() -> None:
    quits = DeterministicPolicy.from_actions(FORK, {"a": "over", "edge": GIVE_UP})
    rows = {(r.state, r.memory): r.action for r in acting_everywhere(quits).table()}
    assert rows["edge", None] is GIVE_UP
    assert rows["edge", "over"] == "slide"
    assert rows["a", None] == "over"
    assert rows["far", None] == "fly"
    assert {state for state, _ in rows} == {
        FORK.states[k] for k in np.flatnonzero(np.diff(FORK.pair_offsets) > 0)
    }
    limited = MCMP(FORK, "a", 0.1, constraints={"seen": visits("grave", through_failure=True) <= 0})
    told = {(r.state, r.memory): r.action for r in solve(limited).policy.table()}
    assert told["edge", "giving up"] == "slide"
    assert dead_ends(FORK).sum() == 2


# Policies that tell very many levels of cost apart, from steps of very different costs.


GOAL, PIT = "home", "pit"
WORKS = {
    "a": {
        "try": [(0.1, GOAL, 1e-3), (0.5, "b", 1.0), (0.4, PIT, 1e3)],
        "wait": [(0.6, "a", 1.0), (0.3, "b", 1e3), (0.1, GOAL, 2e3)],
    },
    "b": {
        "try": [(0.3, GOAL, 1e3), (0.3, "a", 1e-3), (0.4, PIT, 1.0)],
        "wait": [(0.7, "b", 2e3), (0.2, "a", 1.0), (0.1, GOAL, 1e-3)],
    },
}


@pytest.fixture(scope="module")
def problem() -> S3P:
    """Costs a millionfold apart, so that totals are told apart on a grid."""
    model = SSP.from_transitions(WORKS, [GOAL], treat_actionless_as_dead_ends=True)
    return S3P(model, "a", failure_budget=0.3, cost_levels=2_000)


def test_a_chain_is_the_same_step_by_step_and_searched_at_once(
    problem: S3P, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever way its nodes are found, nodes, moves and decisions are the same."""
    start = start_distribution(problem.model, problem.start)
    for member in solve(problem, tolerance=1e-2).policy.policies:
        chains = []
        for rounds in (0, 3, 10**9):
            monkeypatch.setattr(chain, "_MANY_ROUNDS", rounds)
            chains.append(chain.policy_chain(problem.model, member, start))
        first, *others = chains
        for other in others:
            for name in ("state", "memory", "start", "dead", "give_up"):
                assert np.array_equal(getattr(first, name), getattr(other, name))
            assert (abs(first.matrix - other.matrix) > 1e-15).nnz == 0
        assert first.n_nodes > 20


def test_a_bound_outlives_the_time_for_evaluating_policies(
    problem: S3P, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the time ends before any policy was evaluated, the bound of the search still counts."""
    optimum = solve(problem)
    assert evaluate(optimum.policy, problem).objective == pytest.approx(optimum.objective)
    assert optimum.gap < 5e-2

    def out_of_time(*_: object) -> None:
        raise Stop

    with monkeypatch.context() as patched:
        patched.setattr(rows, "true_lottery", out_of_time)
        for module in (rows, refinement):
            patched.setattr(module, "is_late", lambda: True)
        with pytest.raises(Stop) as stopped:
            rows.rows_optimum(
                stated := rows.compiled_constrained(problem),
                SolveOptions(1e-6),
                rows.true_figures(problem, stated),
            )
    assert stopped.value.choice.value == np.inf
    assert stopped.value.choice.bound == pytest.approx(optimum.lower_bound, rel=5e-2)
