"""Searches on the graph of a model."""

from pathlib import Path

import numpy as np
import pytest

from formulations import MCMP, MaxProb
from small_models import model_of
from ssp_lp import SSP, ModelError, certify, evaluate, simulate, solve, within_steps
from ssp_lp.compiled.accelerator import SWITCH, has_accelerator
from ssp_lp.io import load_policy, save_policy
from ssp_lp.model import graph

# Searches on the graph: numpy whole, numpy in pieces and compiled, against plain sets.


PATHS = {"whole": (1 << 22, False), "pieces": (3, False), "compiled": (1 << 22, True)}


@pytest.fixture(params=PATHS)
def path(request, monkeypatch):
    """One of the ways in which the searches run."""
    chunk, compiled = PATHS[request.param]
    if compiled and not has_accelerator():
        pytest.skip("no accelerator")
    monkeypatch.setattr("ssp_lp.arrays.CHUNK", chunk)
    monkeypatch.setenv(SWITCH, "numba" if compiled else "none")


def drawn_model(seed, n_states):
    """A model with idle states, repeated successors and outcomes of probability 0; and its rng."""
    rng = np.random.default_rng(seed)
    goals = rng.choice(n_states, size=rng.integers(1, 3), replace=False)
    counts = rng.integers(0, 4, size=n_states)
    counts[goals] = 0
    spread = rng.integers(1, 5, size=counts.sum())
    offsets = np.concatenate([[0], np.cumsum(spread)])
    weights = rng.integers(0, 3, size=offsets[-1])
    weights[offsets[:-1]] += 1
    sums = np.add.reduceat(weights, offsets[:-1]) if spread.size else weights
    near = np.repeat(np.repeat(np.arange(n_states), counts), spread)
    model = SSP.from_arrays(
        pair_offsets=np.concatenate([[0], np.cumsum(counts)]),
        outcome_offsets=offsets,
        successors=(near + rng.integers(-2, 3, size=offsets[-1])) % n_states,
        probabilities=weights / np.repeat(sums, spread),
        costs=1.0,
        goal_states=goals,
        treat_actionless_as_dead_ends=True,
    )
    return model, rng


def steps_of(model):
    """The possible successors of each pair, as sets."""
    ends = model.outcome_offsets
    return [
        {int(model.successors[k]) for k in range(ends[p], ends[p + 1]) if model.probabilities[k]}
        for p in range(model.n_pairs)
    ]


def pairs_of(model, state):
    return range(model.pair_offsets[state], model.pair_offsets[state + 1])


def members(mask):
    return set(np.flatnonzero(mask).tolist())


SEEDS = [(seed, n) for seed in range(8) for n in (3, 8, 25)]
each_model = pytest.mark.parametrize(("seed", "n_states"), SEEDS)


@each_model
def test_predecessors_turn_the_graph_round(path, seed, n_states):
    model, _ = drawn_model(seed, n_states)
    before = model.predecessors
    outcomes = np.flatnonzero(model.probabilities > 0)
    pair_of = np.repeat(np.arange(model.n_pairs), np.diff(model.outcome_offsets))
    for state in range(n_states):
        expected = pair_of[outcomes[model.successors[outcomes] == state]]
        found = before.pairs[before.offsets[state] : before.offsets[state + 1]]
        assert found.tolist() == expected.tolist()
    assert before.pairs.dtype == np.int32
    assert not before.pairs.flags.writeable


@each_model
def test_dead_ends_attention_states_and_pairs_that_lead_somewhere(path, seed, n_states):
    model, rng = drawn_model(seed, n_states)
    steps, goals = steps_of(model), members(model.goal_mask)
    ahead = [{s}.union(*(steps[p] for p in pairs_of(model, s))) for s in range(n_states)]
    for _ in range(n_states):
        ahead = [set().union(*(ahead[t] for t in known)) for known in ahead]
    assert members(graph.dead_ends(model)) == {s for s in range(n_states) if not ahead[s] & goals}
    kept, stay = None, set(range(n_states)) - goals
    while stay != kept:
        kept = stay
        stay = {s for s in kept if any(steps[p] <= kept for p in pairs_of(model, s))}
        stay |= {s for s in kept if not pairs_of(model, s)}
    attention = graph.attention_states(model)
    assert members(attention) == kept
    staying = {p for p in range(model.n_pairs) if steps[p] | {int(model.pair_state[p])} <= kept}
    assert members(graph.attention_pairs(model, attention)) == staying
    some = rng.random(n_states) < 0.3
    expected = {p for p in range(model.n_pairs) if steps[p] & members(some)}
    assert members(graph.pairs_into(model, some)) == expected


def test_pairs_without_outcomes_lead_nowhere(path):
    """Of a process, whose pairs may do no more than end."""
    arrays = np.array([0, 2, 4]), np.array([0, 0, 2, 2, 3]), np.array([0, 1, 1], dtype=np.int32)
    process = graph.Graph(*arrays, np.array([0.5, 0.0, 1.0]))
    assert members(graph.pairs_into(process, np.array([True, False]))) == {1}
    assert members(graph.pairs_into(process, np.array([False, True]))) == {3}
    nothing = graph.Graph(np.array([0, 1]), np.array([0, 0]), arrays[2][:0], np.zeros(0))
    assert not graph.pairs_into(nothing, np.array([True])).any()


@each_model
def test_states_from_which_the_goal_is_sure(path, seed, n_states):
    model, _ = drawn_model(seed, n_states)
    steps, kept, near = steps_of(model), None, set(range(n_states))
    while near != kept:
        kept, near = near, members(model.goal_mask)
        pairs = [p for p in range(model.n_pairs) if steps[p] | {int(model.pair_state[p])} <= kept]
        for _ in range(n_states):
            near |= {int(model.pair_state[p]) for p in pairs if steps[p] & near}
        near &= kept
    states, staying, _ = graph.surely_reaching(model)
    assert members(states) == kept
    assert members(staying) == set(pairs)


@pytest.mark.parametrize("everything", [True, False])
@each_model
def test_approach_takes_the_first_of_the_nearest_pairs(path, seed, n_states, everything):
    model, rng = drawn_model(seed, n_states)
    steps = steps_of(model)
    leaving = rng.random(model.n_pairs) < 0.15
    usable = np.full(model.n_pairs, True) if everything else rng.random(model.n_pairs) < 0.7
    choice = graph.nearer_pairs(model, leaving, None if everything else usable)
    expected, near = {}, None
    while near is None or near:
        near = {
            state: useful[0]
            for state in set(range(n_states)) - set(expected)
            if (
                useful := [
                    p
                    for p in pairs_of(model, state)
                    if usable[p] and (leaving[p] if near is None else steps[p] & set(near))
                ]
            )
        }
        expected |= near
    assert choice.tolist() == [expected.get(s, -1) for s in range(n_states)]


def test_scipy_is_given_numbers_of_32_bits(accelerate, monkeypatch):
    """Its searches before version 1.15 take no others."""
    accelerate(False)
    model, rng = drawn_model(*SEEDS[0])
    graphs, search = [], graph.sp.csgraph.breadth_first_order

    def kept(given, *rest, **named):
        graphs.append(given)
        return search(given, *rest, **named)

    monkeypatch.setattr(graph.sp.csgraph, "breadth_first_order", kept)
    graph.nearer_pairs(model, rng.random(model.n_pairs) < 0.5)
    graph.reaching_states(model, model.goal_mask)
    assert [(g.indices.dtype, g.indptr.dtype) for g in graphs] == 2 * [(np.int32, np.int32)]


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
@each_model
def test_end_components_are_the_maximal_ones(path, seed, n_states, share):
    model, rng = drawn_model(seed, n_states)
    allowed = rng.random(model.n_pairs) < share
    component, inside = graph.end_components(model, allowed)
    expected, kept = plain_components(model, allowed)
    assert members(inside) == kept
    assert component.tolist() == expected


def plain_components(model, allowed):
    """End components by dropping, again and again, pairs that leave what comes back to them."""
    steps, kept = steps_of(model), members(allowed)
    while True:
        ahead = {s: {s} for s in range(model.n_states)}
        for _ in range(model.n_states):
            for pair in kept:
                for known in ahead.values():
                    if int(model.pair_state[pair]) in known:
                        known |= steps[pair]
        acting = {int(model.pair_state[p]) for p in kept}
        stay = {
            p
            for p in kept
            if all(s in acting and int(model.pair_state[p]) in ahead[s] for s in steps[p])
        }
        if stay == kept:
            break
        kept = stay
    least = {s: min(t for t in ahead[s] if s in ahead[t]) for s in acting}
    order = sorted(set(least.values()))
    return [order.index(least[s]) if s in least else -1 for s in range(model.n_states)], kept


# Going on for so many steps as a goal.


@pytest.mark.parametrize("steps", [1, 2, 7, 30])
def test_surviving_can_be_the_goal(steps: int, tmp_path: Path) -> None:
    """The greatest probability of going on for so long is one recursion from the end."""
    walk = {
        "rope": {
            "stride": [(0.9, "rope", 1.0), (0.1, "net", 1.0)],
            "rest": [(0.96, "ledge", 4.0), (0.04, "net", 4.0)],
        },
        "ledge": {"wait": [(0.99, "ledge", 0.0), (0.01, "sky", 0.0)], "step": [(1.0, "rope", 2.0)]},
        "net": {},
    }
    model = SSP.from_transitions(walk, goal={"sky"}, treat_actionless_as_dead_ends=True)
    alive = within_steps(model, steps, start=["rope"], survive=True)
    greatest = {"rope": 1.0, "ledge": 1.0, "sky": 1.0, "net": 0.0}
    for _ in range(steps):
        greatest |= {
            state: max(sum(p * greatest[there] for p, there, _ in some) for some in acts.values())
            for state, acts in walk.items()
            if acts
        }
    best = solve(MaxProb(alive, ("rope", 0)))
    assert best.objective == pytest.approx(greatest["rope"], rel=1e-12)
    assert certify(best).accepted
    problem = MCMP(alive, ("rope", 0), failure_budget=1.0 - 0.9 * greatest["rope"])
    solution = solve(problem)
    report = simulate(
        solution.policy,
        problem,
        episodes=4_000,
        seed=np.random.default_rng(steps),
        confidence=0.9999,
    )
    interval = report.failure_probability
    assert interval.low <= solution.budget_used <= interval.high
    save_policy(solution.policy, tmp_path / "alive.npz")
    again = load_policy(tmp_path / "alive.npz", alive)
    assert evaluate(again, problem).failure_probability == pytest.approx(solution.budget_used)


def test_states_that_are_to_be_survived_may_have_actions() -> None:
    """Who lies in the net may stay there for ever: surviving is said by a label."""
    walk = {
        "rope": {"stride": [(0.9, "rope", 1.0), (0.1, "net", 1.0)]},
        "net": {"lie": [(1.0, "net", 0.0)]},
    }
    model = model_of(walk, "nowhere", labels={"fallen": ["net"]})
    for lost in (["fallen"], "fallen"):
        alive = within_steps(model, 5, start=["rope"], survive=lost)
        assert solve(MaxProb(alive, ("rope", 0))).objective == pytest.approx(0.9**5)
    alive = within_steps(model, 5, start=["rope"], survive=True)
    assert solve(MaxProb(alive, ("rope", 0))).objective == pytest.approx(1.0)
    with pytest.raises(ModelError, match="label 'falen'; did you mean 'fallen'"):
        within_steps(model, 5, survive=["falen"])
    back = model_of({"rope": {"go": [(1.0, "net", 1.0)]}, "net": {"up": [(1.0, "rope", 1.0)]}},
                    "nowhere", labels={"fallen": ["net"]})  # fmt: skip
    with pytest.raises(ModelError, match="'net' can be left"):
        within_steps(back, 2, survive="fallen")
    with pytest.raises(ModelError, match="survive must be True, False or labels"):
        within_steps(model, 2, survive=None)
