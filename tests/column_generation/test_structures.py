"""Models of every structure: certified, the same compiled or not, and what is known of them."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from examples.solver_comparison.instances.families import FAMILIES, grid
from formulations import MCMP, S3P, ConstrainedCost, FinitePenalty, MaxProb
from small_models import model_of
from ssp_lp import SolverError, certify, evaluate, solve
from ssp_lp.column_generation.column import least_of
from ssp_lp.compiled import accelerator
from ssp_lp.formulation import CostLimit
from written_models import written

SIZES = {
    "layered": (30, 20), "scattered": (1_500,), "grid": (40,), "river": (20, 60),
    "corridor": (1_500,), "rooms": (15, 10), "ring": (1_500,),
    "holes": (40,), "headings": (14,), "racetrack": (7,), "tandem": (30,), "inventory": (20, 20),
    "sysadmin": (8,), "factored": (9,), "blocks": (4,),
}  # fmt: skip
GAP = 1e-9
slowly = pytest.mark.parametrize("power", range(3, 13))


def proved(problem):
    """The solution, whose proof has been looked at."""
    solution = solve(problem)
    proof = certify(solution)
    assert proof.accepted, proof.reason
    assert max(solution.gap, proof.gap) <= GAP
    return solution


@pytest.fixture(params=[False, True], ids=["numpy", "compiled"])
def compiled(request, monkeypatch):
    """Run every loop compiled, or none."""
    pytest.importorskip("numba")
    monkeypatch.setenv(accelerator.SWITCH, "numba" if request.param else "none")


@pytest.mark.parametrize("family", FAMILIES)
def test_every_structure_is_solved_to_proof(family, monkeypatch):
    """At least failure and within a budget, with compiled loops and with numpy."""
    pytest.importorskip("numba")
    model = FAMILIES[family](*SIZES[family])
    least = 1.0 - solve(MaxProb(model, 0)).objective
    for budget in (None, min(2.0 * least + 0.01, 1.0)):
        found = []
        for wish in ("numba", "none"):
            monkeypatch.setenv(accelerator.SWITCH, wish)
            solution = proved(MCMP(model, 0, budget, give_up="dead_ends"))
            most = 1.0 if budget is None else budget
            assert 0.0 <= solution.failure_probability <= most + 1e-12
            found.append(solution.objective)
        assert found[0] == pytest.approx(found[1], rel=1e-9)


# Four thousand states: the answer's two sides worked out apart from the library


def transitions(model):
    parts = model.probabilities, model.successors, model.outcome_offsets
    return sp.csr_array(parts, shape=(model.n_pairs, model.n_states))


def stage_costs(model):
    return np.add.reduceat(model.probabilities * model.costs, model.outcome_offsets[:-1])


def measured(model, policy, *, mixes):
    """Expected cost and failure from state 0, from the visits of the policy's chain."""
    n = model.n_states - 2
    acting = np.flatnonzero(policy.decision[:n] >= 0)
    taken = transitions(model)[policy.decision[acting]]
    chain = sp.csc_array(sp.csr_array(taken)[:, acting].T)
    begin = (acting == 0).astype(float)
    if mixes:
        visits, going = np.zeros(acting.size), begin
        while going.sum() > 1e-18:
            visits, going = visits + going, chain @ going
    else:
        visits = splu(sp.csc_array(sp.eye_array(acting.size) - chain)).solve(begin)
    goal = float(visits @ taken[:, [n]].toarray().ravel())
    return float(visits @ stage_costs(model)[policy.decision[acting]]), 1.0 - goal


def least_advantage(model, solution):
    """The least of ``c + price * failing + P v - v`` over all pairs; v is 0 at both ends."""
    values, n = np.append(solution.value_function, [0.0, 0.0]), model.n_states - 2
    trapped = np.zeros(n + 2)
    trapped[n + 1] = solution.failure_price
    ahead = stage_costs(model) + transitions(model) @ (values + trapped)
    return float((ahead - values[model.pair_state]).min() / max(1.0, np.abs(values).max()))


@pytest.mark.parametrize(
    ("family", "size", "more"),
    [
        *(("layered", size, {}) for size in ((400, 10), (40, 100), (8, 500))),
        ("scattered", (4_000,), {}),
        *(("grid", (64,), {"wind": wind, "seed": 1}) for wind in (0.0, 0.1, 0.3)),
        *(("river", size, {"current": 0.2}) for size in ((30, 133), (130, 31))),
        *(("corridor", (4_000,), {"drift": drift}) for drift in (0.01, 0.06)),
        *(("rooms", size, {}) for size in ((10, 20), (40, 10))),
        *(("ring", (4_000,), {"leak": leak}) for leak in (1e-3, 1e-5, 1e-7)),
    ],
)
def test_both_sides_of_the_optimum(family, size, more):
    """The policy is measured on its own chain, the value function is seen to be a sub-solution.

    Together they prove the optimum. At least failure MCMP and S3P have one probability.
    """
    model = FAMILIES[family](*size, **more)
    least = 1.0 - solve(MaxProb(model, 0)).objective
    for share in (0.02, 0.5):
        budget = least + share * (1.0 - least) * 0.1
        solution = solve(MCMP(model, 0, budget, give_up="dead_ends"))
        assert solution.gap <= GAP
        members = zip(solution.policy.weights, solution.policy.policies, strict=True)
        figures = [(w, *measured(model, m, mixes=family == "scattered")) for w, m in members]
        cost, failure = (sum(row[0] * row[k] for row in figures) for k in (1, 2))
        assert solution.objective == pytest.approx(cost, rel=1e-8)
        assert solution.failure_probability == pytest.approx(failure, abs=1e-8)
        assert failure <= budget + 1e-8
        assert least_advantage(model, solution) >= -1e-12
        bound = solution.value_function[0] - solution.failure_price * budget
        assert bound == pytest.approx(solution.objective, rel=1e-8)
    for criterion in (MCMP, S3P):
        safest = solve(criterion(model, 0))
        assert safest.goal_probability == pytest.approx(1.0 - least, rel=1e-9)
        assert certify(safest).accepted
        assert criterion is S3P or safest.gap <= GAP


# Small ones, known in closed form


@pytest.mark.parametrize("give_up", ["anywhere", "attention", "dead_ends"])
@pytest.mark.parametrize("side", [20, 60])
def test_windy_grids_agree_with_the_full_program(give_up, side):
    """The grids on which rough evaluations used to adopt policies that never leave."""
    solution = proved(problem := MCMP(grid(side), 0, 0.05, give_up=give_up))
    found = evaluate(solution.policy, problem)  # each summed from its own exits
    assert found.goal_probability + found.failure_probability == pytest.approx(1.0, abs=1e-14)
    if side == 20:
        program = solve(problem, method="lp")
        assert program.objective == pytest.approx(solution.objective, rel=1e-6)


@pytest.mark.parametrize("cells", [3, 200, 3_000])
def test_a_corridor_takes_as_long_as_the_closed_form_says(cells):
    """A walk with drift d that is reflected at 0: n / d - (q / d^2) (1 - (q / p)^n) steps."""
    drift = 0.02
    up, down = 0.5 + drift / 2, 0.5 - drift / 2
    walk = {k: {"walk": [(up, k + 1, 1.0), (down, max(k - 1, 0), 1.0)]} for k in range(cells)}
    steps = cells / drift - (down / drift**2) * (1 - (down / up) ** cells)
    solution = solve(MCMP(model_of(walk, cells), 0))
    assert solution.objective == pytest.approx(steps, rel=1e-10)
    assert solution.failure_probability == 0.0


@slowly
@pytest.mark.parametrize("criterion", [MCMP, S3P])
def test_a_sure_action_beats_a_loop_that_is_hardly_left(power, criterion):
    """At least failure both are sure; walking costs 1, trying again 1e5 times what it seems."""
    p = 10.0**-power
    model = written(
        f"""
        reset go: {1 - p / 3} try 0.1, {p / 3} g 1
        try again: {1 - p} reset 0.3, {p} g 1
        try walk: g 1
        """
    )
    solution = solve(criterion(model, "try"))
    assert (solution.objective, solution.goal_probability) == (1.0, 1.0)
    assert certify(solution).lower_bound == pytest.approx(1.0, abs=1e-12)
    assert solution.failure_probability == 0.0


@slowly
def test_the_better_exit_of_a_slow_loop_is_told(power):
    """Exits of 9 : 1 and 8 : 2, differing by 1e-13 a step: closed form of the better loop."""
    p = 10.0**-power
    q = p / 3
    model = written(
        f"""
        a good: {1 - q} b 0.1, {0.9 * q} g 1, {0.1 * q} lost 0
        a poor: {1 - q} b 0.2, {0.8 * q} g 1, {0.2 * q} lost 0
        b again: {1 - p} a 0.3, {0.7 * p} g 1, {0.3 * p} lost 0
        b leave: 0.5 g 1, 0.5 lost 0
        """
    )
    best = (0.9 * q + (1 - q) * 0.7 * p) / (q + (1 - q) * p)
    objective = solve(MaxProb(model, "a")).objective
    assert objective == pytest.approx(best, rel=1e-12)
    assert objective <= 1.0
    tight = solve(MCMP(model, "a", 0.3))
    assert tight.gap <= GAP
    assert certify(tight).accepted


def test_a_failure_of_one_in_a_trillion_is_not_one_minus_something():
    solution = solve(FinitePenalty(written(f"x go: {1 - 1e-12} g 1, 1e-12 d 0"), "x", 1e6))
    assert solution.failure_probability == pytest.approx(1e-12, rel=1e-14)
    assert certify(solution).failure == pytest.approx(1e-12, rel=1e-14)


def test_a_state_out_of_reach_that_hardly_leaves_its_loop_does_not_spoil_the_program():
    model = written(f"x go: g 1\n u loop: {1 - 1e-9} u 1, 1e-9 g 1")
    assert solve(MCMP(model, "x", 0.5), method="lp").objective == pytest.approx(1.0)


def test_limits_that_two_policies_meet_to_the_ninth_digit():
    """HiGHS takes the master's rows to contradict each other; one policy keeps to them."""
    model = written(
        f"""
        a go: b 0
        b dear: {1 - 1e-11} c 0, 1e-11 g 0
        b fair: c 0
        c stay: {1 - 1e-9} c 1, 1e-9 g 1
        """
    )
    spent = {"b": {"dear": 2.0, "fair": 1.0}, "c": {"stay": 1.0}}
    limits = {"fuel": CostLimit(spent, 1000000001.4949999)}
    solution = solve(ConstrainedCost(model, "a", limits=limits))
    assert solution.objective == pytest.approx(999999999.995, rel=1e-12)


def test_an_idle_limit_costs_no_accuracy():
    model = written(
        f"""
        s slip: {1 - 6.7e-6} t 2, 6.7e-6 s 2
        s step: t 2
        s wait: s 0
        t try: {1 - 1.6e-8} s 1, 1.6e-8 g 1
        """
    )
    idle = {"fuel": CostLimit({"s": {"slip": 0.0, "step": 0.0, "wait": 0.0}}, 0.0)}
    plain = solve(MCMP(model, "s", 0.5))
    limited = solve(ConstrainedCost(model, "s", failure_budget=0.5, limits=idle))
    assert limited.objective == pytest.approx(plain.objective, rel=1e-12)
    assert limited.gap <= GAP


def test_a_bound_above_a_value_is_a_contradiction():
    assert least_of(1.0 + 1e-12, 1.0) == 1.0
    with pytest.raises(SolverError, match="lies below the lower bound"):
        least_of(2.0, 1.0)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(("seldom", "better"), [(2e-4, 1e-10), (1e-3, 1e-11), (1e-4, 1e-10)])
def test_a_pair_that_is_better_by_a_ten_billionth_is_the_only_one(seldom, better):
    """In a loop of two states: the dearer exit succeeds more often, and is all that may be used."""
    q, h = seldom, 0.5 + better
    model = written(
        f"""
        a cheap: {1 - q} b 1, {q * 0.5} g 1, {q * 0.5} d 1
        a dear: {1 - q} b 2, {q * h} g 2, {q * (1 - h)} d 2
        b on: a 0
        """
    )
    assert solve(MaxProb(model, "a")).objective == pytest.approx(h, rel=1e-13)
    for criterion in (MCMP, S3P):
        assert solve(criterion(model, "a")).objective == pytest.approx(2.0 / q, rel=1e-10)


def test_a_loop_that_only_pays_in_the_end_is_taken():
    """Its advantage is 1e-18 a step; from where the policy stands no run is longer than 3 steps."""
    risk, leave = 2.84e-7, 1.27e-11
    model = written(
        f"""
        a go: b 1
        b hurry: {1 - risk} c 1, {risk} d 1
        b wait: {1 - leave} a 1, {leave} c 1
        c end: 0.45 g 1, 0.55 d 1
        """
    )
    solution = solve(MaxProb(model, "a"))
    assert solution.objective == pytest.approx(0.45, rel=1e-12)
    assert solution.gap <= GAP
    assert solve(MCMP(model, "a")).objective == pytest.approx(2.0 / leave + 1.0, rel=1e-9)


@pytest.mark.usefixtures("compiled")
def test_who_gains_nothing_by_giving_up_goes_on():
    problem = MCMP(written("a go: g 0"), "a", 1.0, give_up="anywhere")
    assert solve(problem).failure_probability == 0.0


WAITING = "a on: b 1\n a wait: a 1\n b on: g 1\n b back: a 1\n c on: a 1\n c wait: c 0"
ROUND = """
    a go: 0.5 b 0, 0.5 g 1
    a pit: p 0
    a dear: g 3
    b go: 0.5 a 0, 0.25 g 2, 0.25 p 1
    """


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize(
    ("model", "gamma", "best"), [(WAITING, 0.9, 2.0 / 0.9), (ROUND, None, 1.2)]
)
def test_free_steps_that_go_round_keep_the_bound(model, gamma, best, fast, accelerate):
    """Nothing is taken off where giving up is worth nothing exactly, at a budget of 1, too."""
    accelerate(fast)
    for budget in (1.0, 0.9):
        solution = solve(S3P(written(model), "a", budget, discount=gamma))
        assert solution.objective == pytest.approx(best, rel=1e-9)
        assert max(solution.gap, certify(solution).gap) <= 1e-8
