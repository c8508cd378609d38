"""What becomes of answers that lie with PETSc's ranks, beside one process alone: for mpiexec.

Policies are measured, certified, played, saved and read where the model's rows lie. The script ends
with an error where that differs from what one process makes of the same policy. Its argument is how
many drawn models there are; or a folder, and whether a policy is saved there or read.
"""

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from mpi4py import MPI
from on_every_rank import DUPLICATES, least_failure
from on_partitioned_models import ENDS, partitioned, questions, with_fuel

from formulations import MCMP, S3P, CVaR
from random_models import drawn_model
from small_models import FIRST, model_of
from ssp_lp import ModelError, evaluate, secondary_cost, solve, visits
from ssp_lp.distributed import PartitionedModel, PartitionedPolicy
from ssp_lp.model.graph import end_marks
from ssp_lp.policies.policy import GIVE_UP_CODE, UNDECIDED

COMM = MPI.COMM_WORLD
EXACT = {"rel": 1e-9, "abs": 1e-12}


def drawn_policy(made, seed, members=2, quits=None):
    """A lottery over any actions at all, and giving up in some states, the same on all ranks."""
    model, rng = made.slab, np.random.default_rng(seed)
    counts = COMM.allreduce(np.diff(model.pair_offsets))
    every = rng.integers(0, np.maximum(counts, 1), size=(members, model.n_states))
    every = np.where(counts > 0, every, UNDECIDED)
    if quits is not None:
        every = np.where(quits & (rng.random(every.shape) < 0.4), GIVE_UP_CODE, every)
    weights = rng.dirichlet(np.ones(members))
    return PartitionedPolicy(made, weights, every[:, model.own])


def check_evaluation(found, known):
    """All that is measured is what one process measures, the same on every rank."""
    assert COMM.allgather(repr(found)) == [repr(found)] * COMM.size
    for name in (
        "goal_probability", "failure_probability", "success_cost", "conditional_cost",
        "expected_cost", "objective", "discounted_failure",
    ):  # fmt: skip
        one, other = getattr(found, name), getattr(known, name)
        assert one == other or one == pytest.approx(other, nan_ok=True, **EXACT), (name, one, other)
    for name in ("ends", "secondary_costs"):
        assert dict(getattr(found, name)) == pytest.approx(dict(getattr(known, name)), **EXACT)


def check_any_policy(seed):
    """Policies that nobody would choose are measured as by one process, whatever is asked."""
    model, _ = drawn_model(seed, 11 + 3 * (seed % 12))
    fuel = 1.0 + np.arange(model.n_outcomes) % 3
    model = replace(model, named_costs={"fuel": fuel}).with_labels({"mire": ["swamp", "s7"]})
    made = partitioned(model)
    limits = {
        "fuel": secondary_cost("fuel") <= 9.0,
        "seen": visits("s3") <= 2.0,
    }
    for asked in (
        {"start": "s0"},
        {"start": {"s0": 0.5, "s1": 0.25, "pit": 0.25}, "constraints": limits},
        {"start": "s0", "discount": 0.9, "constraints": limits},
        {"start": "s0", "give_up": "dead_ends"},
        {"start": "s0", "give_up": "anywhere", "charge_failing_step": False},
    ):
        quits = None
        if asked.get("give_up") == "anywhere":
            quits = np.ones(model.n_states, dtype=bool)
        policy = drawn_policy(made, seed, quits=quits)
        problem = MCMP(model, failure_budget=0.5, **asked)
        found = made.evaluate(policy, MCMP, failure_budget=0.5, **asked)
        check_evaluation(found, evaluate(policy.on(model), problem))
    policy = drawn_policy(made, seed)
    found = made.evaluate(policy, S3P, start="s0", failure_budget=0.9)
    check_evaluation(found, evaluate(policy.on(model), S3P(model, "s0", 0.9)))


def check_answer(model, made, criterion, asked):
    """An answer is measured as it says, certified, and refused once anything of it is changed."""
    answer = made.solve(criterion, **asked)
    found = made.evaluate(answer.policy, criterion, **asked)
    check_evaluation(found, evaluate(answer.policy.on(model), criterion(model, **asked)))
    assert found.objective == pytest.approx(answer.objective, rel=1e-9, abs=1e-12)
    assert found.limited_failure == pytest.approx(answer.failure, rel=1e-9, abs=1e-12)
    each = [made.evaluate(one, criterion, **asked) for one in answer.policy.members]
    figures = [[one.objective, one.limited_failure] for one in each]
    assert np.allclose(figures, answer.figures[:, :2], rtol=1e-9, atol=1e-12)
    certificate = made.certify(answer)
    assert COMM.allgather(repr(certificate)) == [repr(certificate)] * COMM.size
    assert certificate.accepted, (certificate, criterion, asked)
    assert certificate.gap <= 1e-9, certificate
    return answer


def refused(made, answer, why):
    """A changed answer is refused on every rank, for this reason."""
    certificate = made.certify(answer)
    assert not certificate.accepted, certificate
    assert why in certificate.reason, certificate.reason
    assert COMM.allgather(certificate.reason) == [certificate.reason] * COMM.size


def check_changed_answers():
    """Whatever is changed in an answer is found."""
    model, fuel = with_fuel(model_of(DUPLICATES)), {"fuel": secondary_cost("fuel") <= 6.2}
    made = partitioned(model)
    answer = check_answer(
        model, made, MCMP, {"start": "x", "failure_budget": 0.3, "constraints": fuel}
    )
    made = partitioned(FIRST)
    asked = {"start": "depot", "failure_budget": 0.05}
    answer = check_answer(FIRST, made, MCMP, asked)
    policy, values = answer.policy, answer.value_function
    assert len(policy.weights) == 2
    for raised in (values + 1e-6, values * (1.0 + 1e-9)):
        refused(made, replace(answer, value_function=raised), "in state 'depot' it is too high by")
    refused(made, replace(answer, value_function=values - 1e-6), "the value function proves")
    refused(made, replace(answer, value_function=values[1:]), "a value function of shape")
    assert made.certify(replace(answer, value_function=values + np.inf)).gap <= 1e-9
    for factor, why in ((0.999, "too high"), (1.001, "proves"), (-1.0, "a price is not")):
        prices = {name: factor * price for name, price in answer.prices.items()}
        refused(made, replace(answer, prices=prices), why)
    safe = np.array([[1.0, 0.0], [0.0, 1.0]])[np.argmin(policy.weights)]
    for weights in (safe, 1.0 - safe, policy.weights[::-1]):
        changed = replace(answer, policy=replace(policy, weights=weights))
        why = (
            "above the budget"
            if made.evaluate(changed.policy, MCMP, **asked).failure_probability > 0.05 + 1e-9
            else "the policy is worth"
        )
        refused(made, changed, why)
    other = policy.positions.copy()
    if made.slab.first == 0 < made.slab.end:
        other[:, 0] = 1  # by road
    assert FIRST.states[0] == "depot"
    refused(made, replace(answer, policy=replace(policy, positions=other)), "the policy is worth")
    refused(made, replace(answer, objective=answer.objective * 1.001), "the policy is worth")
    refused(made, replace(answer, failure=answer.failure + 0.001), "the policy fails with")
    refused(made, replace(answer, lower_bound=answer.objective * 1.001), "proves")


def plain_draw(shares, word):
    """The entry that a random word draws, in Python's own whole numbers."""
    units = [round(float(share) * 2**62) for share in shares]
    level, entry = word * sum(units) >> 64, 0
    while level >= units[entry]:
        level, entry = level - units[entry], entry + 1
    return entry


def plain_words(seed, episode, step):
    """Random words by numpy's own Philox, which adds one to its counter before it draws."""
    counter = (episode + (step << 64) - 1) % 2**256
    words = [counter >> (64 * k) & (2**64 - 1) for k in range(4)]
    key, counter = np.array([seed, 0], dtype=np.uint64), np.array(words, dtype=np.uint64)
    return [int(word) for word in np.random.Philox(key=key, counter=counter).random_raw(4)]


def plain_path(model, start, policy, every, seed, episode, steps):
    """An episode's states, one step after the other, and what it paid on the way."""
    words = plain_words(seed, episode, 0)
    path, member = [plain_draw(start, words[0])], plain_draw(policy.weights, words[1])
    over, costs = end_marks(model) >= 0, 0.0
    for step in range(1, steps + 1):
        state = path[-1]
        if over[state] or every[member, state] == GIVE_UP_CODE:
            break
        pair = model.pair_offsets[state] + every[member, state]
        outcomes = np.arange(*model.outcome_offsets[[pair, pair + 1]])
        drawn = plain_draw(model.probabilities[outcomes], plain_words(seed, episode, step)[0])
        path.append(int(model.successors[outcomes[drawn]]))
        costs += model.costs[outcomes[drawn]]
    return path, costs


def check_simulation(model, policy, asked, *, plainly=0):
    """Episodes are those of a plain loop, on any number of ranks; means are as measured."""
    made, problem = policy.model, MCMP(model, failure_budget=0.5, **asked)
    exact, settings = evaluate(policy.on(model), problem), {"seed": 2**40 + 3, "max_steps": 200}
    report = made.simulate(policy, MCMP, failure_budget=0.5, **asked, **settings,
                           episodes=4000, record=plainly, confidence=1.0 - 1e-6)  # fmt: skip
    assert COMM.allgather(repr(report)) == [repr(report)] * COMM.size
    assert sum(report.ends.values()) == report.episodes == 4000
    assert len(report.paths) == plainly
    start, every = problem._begun, policy.gathered()
    for k, path in enumerate(report.paths):
        known, _ = plain_path(model, start, policy, every, settings["seed"], k, 200)
        assert path.tolist() == known
    goal, cost = report.goal_probability, report.expected_cost
    if not report.ends["unfinished"]:
        assert goal.low <= exact.goal_probability <= goal.high
        assert cost.low <= exact.expected_cost <= cost.high
        spread = report.success_costs.std() / np.sqrt(max(report.success_costs.size, 1))
        if report.success_costs.size:
            miss = abs(report.conditional_cost.value - exact.conditional_cost)
            assert miss <= 5.0 * spread + 1e-9


def check_simulations():
    """Answers and any policies, with and without giving up, are played."""
    small = model_of(ENDS)
    ends = partitioned(small)
    for asked in ({}, {"give_up": "dead_ends"}, {"charge_failing_step": False}):
        policy = drawn_policy(ends, 2)
        check_simulation(small, policy, {"start": {"x": 0.75, "skid": 0.25}} | asked, plainly=20)
    answer = partitioned(FIRST).solve(MCMP, start="depot", failure_budget=0.05)
    check_simulation(FIRST, answer.policy, {"start": "depot"}, plainly=50)
    for seed in range(2):
        model, _ = drawn_model(seed, 11 + 3 * seed)
        made = partitioned(model)
        quits = np.arange(model.n_states) % 3 == 0
        check_simulation(model, drawn_policy(made, seed), {"start": "s0"}, plainly=20)
        anywhere = {"start": {"s0": 0.5, "s5": 0.5}, "give_up": "anywhere"}
        check_simulation(model, drawn_policy(made, seed, quits=quits), anywhere, plainly=20)


def check_least_failure(seed):
    """Within a budget that only the safest keep to, the cheapest of them is the answer."""
    model, _ = drawn_model(seed, 11 + 3 * (seed % 12))
    asked = {"start": "s0", "failure_budget": least_failure(model, {"start": "s0"})}
    answer = check_answer(model, partitioned(model), MCMP, asked)
    assert answer.objective == pytest.approx(solve(MCMP(model, **asked)).objective, **EXACT)


def check_orders(seed):
    """In whatever order the ranks take the states, all is told in the model's own numbers."""
    model, _ = drawn_model(seed, 11 + 3 * seed)
    order = np.random.default_rng(seed).permutation(model.n_states)
    made, plain = PartitionedModel.from_model(model, order), partitioned(model)
    lowest = least_failure(model, {"start": "s0"})
    asked = {"start": "s0", "failure_budget": lowest + 0.3 * (1.0 - lowest)}
    answer = check_answer(model, made, MCMP, asked)
    values = answer.value_function
    raised = np.where(np.arange(values.size) == values.argmax(), values + 1e-6, values)
    refused(made, replace(answer, value_function=raised), "it is too high by")
    named = plain.slab
    same = PartitionedPolicy(plain, answer.policy.weights, answer.policy.gathered()[:, named.own])
    check_evaluation(
        plain.evaluate(same, MCMP, **asked), made.evaluate(answer.policy, MCMP, **asked)
    )
    outcomes = np.diff(model.outcome_offsets[model.pair_offsets])
    source = np.repeat(np.arange(model.n_states), outcomes)
    steps = {*zip(source.tolist(), model.successors.tolist(), strict=True)}
    report = made.simulate(answer.policy, MCMP, **asked, episodes=50, seed=7, record=50)
    for path in report.paths:
        assert path[0] == model.index_of("s0")
        assert {*pairwise(path.tolist())} <= steps


def check_errors():
    """What cannot be asked is named on every rank."""
    made = partitioned(FIRST)
    answer = made.solve(MCMP, start="depot", failure_budget=0.05)
    asked = {"start": "depot", "failure_budget": 0.05}
    with pytest.raises(ModelError, match="the policy is for another model: "):
        partitioned(model_of(ENDS)).evaluate(answer.policy, MCMP, **asked)
    with pytest.raises(ModelError, match="CVaR makes something of the law"):
        made.evaluate(answer.policy, CVaR, start="depot", level=0.9)
    nothing = np.full_like(answer.policy.positions, UNDECIDED)
    idle = replace(answer.policy, positions=nothing)
    with pytest.raises(ModelError, match="no decision in state 'depot'"):
        made.evaluate(idle, MCMP, **asked)
    quits = replace(answer.policy, positions=np.full_like(nothing, GIVE_UP_CODE))
    with pytest.raises(ModelError, match="gives up in state 'depot'"):
        made.evaluate(quits, MCMP, **asked)
    wrong = nothing.copy()
    wrong[:, -1:] = 7  # perhaps not on all ranks
    for changed, why in (
        ({"positions": wrong}, "is no pair of that state"),
        ({"positions": nothing[:1]}, "positions of shape"),
        ({"weights": [0.5, 0.4]}, "weights must form a distribution"),
    ):
        for measured in (made.certify, lambda one: made.evaluate(one.policy, MCMP, **asked)):
            with pytest.raises(ModelError, match=why):
                measured(replace(answer, policy=replace(answer.policy, **changed)))
    by_cost = made.solve(S3P, start="depot", failure_budget=0.05)
    for measured in (
        lambda: made.certify(by_cost),
        lambda: by_cost.policy.save("nowhere"),
        lambda: made.evaluate(by_cost.policy, S3P, **asked),
    ):
        with pytest.raises(ModelError, match="acts on the cost paid"):
            measured()
    with pytest.raises(ModelError, match="seed"):
        made.simulate(answer.policy, MCMP, **asked, seed=-1)


def check_what_an_earlier_run_proved():
    """A bound by an earlier run's proof is proved again, though its values are not kept."""
    model, question = drawn_model(4, 23)[0], {"start": "s0"}
    model = replace(model, named_costs={"fuel": 1.0 + np.arange(model.n_outcomes) % 3})
    lowest = least_failure(model, question)
    asked = question | {"failure_budget": lowest + 0.3 * (1.0 - lowest)}
    asked["constraints"] = {"fuel": secondary_cost("fuel") <= 20.0}
    made = partitioned(model)
    with TemporaryDirectory() as folder:
        kept = {"checkpoint": Path(COMM.bcast(folder)) / "search.npz"}
        best = made.solve(MCMP, **asked, **kept)
        rough = made.solve(MCMP, **asked, **kept, tolerance=0.5)
    assert rough.lower_bound == pytest.approx(best.lower_bound, rel=1e-9)
    certificate = made.certify(rough)
    assert certificate.accepted, certificate
    assert certificate.gap == pytest.approx(rough.gap, rel=1e-6, abs=1e-9)


def check_saved(folder, ranks):
    """A policy that any number of ranks saved is read, but not for another model."""
    made = partitioned(drawn_model(1, 23)[0])
    policy = drawn_policy(made, 5, members=3)
    if ranks == "saves":
        drawn_policy(made, 6).save(folder)  # which is replaced
        policy.save(folder)
    again = PartitionedPolicy.load(made, folder)
    assert np.array_equal(policy.positions, again.positions)
    assert np.array_equal(policy.weights, again.weights)
    assert repr(again).startswith(f"PartitionedPolicy({made.slab.n_states} states, members")
    with pytest.raises(ModelError, match="the policy is for another model, of"):
        PartitionedPolicy.load(partitioned(FIRST), folder)
    with pytest.raises(FileNotFoundError):
        PartitionedPolicy.load(made, Path(folder) / "nowhere")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        check_saved(*sys.argv[1:])
    else:
        for drawn in range(int(sys.argv[1])):
            check_any_policy(drawn)
        for model, criterion, asked in questions():
            check_answer(model, partitioned(model), criterion, asked)
        check_changed_answers()
        check_what_an_earlier_run_proved()
        check_simulations()
        check_orders(3)
        for seed in (3, 5, 37):
            check_least_failure(seed)
        check_errors()
    if COMM.gather(True) is not None:
        print(f"{COMM.size} ranks: well")
