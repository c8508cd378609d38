"""Failing ends the cost, not the run: what is counted then, and what policies do."""

from dataclasses import replace

import numpy as np
import pytest

from formulations import GUBS, MCMP, S3P, CostQuantile, CVaR, LeastQuantity, MaxProb, MinCost
from ssp_lp import (
    GIVE_UP,
    SSP,
    DeterministicPolicy,
    InfeasibleError,
    ModelError,
    acting_everywhere,
    certify,
    end_probability,
    evaluate,
    expected_cost,
    goal_probability,
    secondary_cost,
    simulate,
    solve,
    visits,
)
from ssp_lp.io import (
    Controller,
    load_policy,
    load_solution,
    save_policy,
    save_solution,
    write_controller,
)
from ssp_lp.problem import compiled_constrained

CONFIDENCE = 0.9999


def model_of(moves, **labels) -> SSP:
    """Moves by state and action to "home"; states without any are dead-ends."""
    return SSP.from_transitions(
        moves, {"home"}, state_labels=labels, treat_actionless_as_dead_ends=True
    )


def skidding(slide=((0.5, "wreck", 0.0), (0.5, "ash", 0.0)), **others) -> SSP:
    """A fast road that may end in a skid, a slow one that does not."""
    moves = {
        "a": {"fast": [(0.9, "home", 1.0), (0.1, "skid", 1.0)], "slow": [(1.0, "home", 10.0)]},
        "skid": {"slide": list(slide), **others.pop("beside", {})},
        **others,
        "wreck": {},
        "ash": {},
    }
    return model_of(moves, crash=["wreck"], fire=["ash"])


SKID = skidding()

FEW = {"crash": end_probability("crash") <= 0.01}

EDGES = {
    "a": {"over": [(0.9, "home", 1.0), (0.1, "edge", 1.0)], "round": [(1.0, "home", 10.0)]},
    "edge": {"slide": [(1.0, "wreck", 1.0)], "climb": [(1.0, "home", 100.0)]},
    "wreck": {},
}
EDGE = model_of(EDGES, crash=["wreck"])
"""Who gives up on the edge falls: nothing else avoids the goal there."""


def mcmp(model: SSP, budget=0.1, **more) -> MCMP:
    return MCMP(model, "a", budget, **{"charge_failing_step": False, **more})


def checked(problem) -> float:
    """The value of a problem, proved, kept to, and the same whichever way it is found."""
    solution = solve(problem)
    assert certify(solution).accepted
    found = evaluate(solution.policy, problem)
    assert found.objective == pytest.approx(solution.objective, rel=1e-9, abs=1e-12)
    assert solve(problem, "lp").objective == pytest.approx(solution.objective, rel=1e-7, abs=1e-9)
    played = simulate(solution.policy, problem, episodes=20_000, seed=1, confidence=CONFIDENCE)
    for name, share in found.ends.items():
        if name != "wandering":
            spread = 4.0 * np.sqrt(share * (1.0 - share) / 20_000) + 1e-9
            assert played.ends[name] / 20_000 == pytest.approx(share, abs=spread), name
    assert played.expected_cost.low <= found.expected_cost <= played.expected_cost.high
    return solution.objective


def test_a_limit_counts_the_true_end() -> None:
    """A fifth goes fast: of these a tenth skids, and half of that is wrecked."""
    assert checked(mcmp(SKID, constraints=FEW)) == pytest.approx(8.2, rel=1e-12)
    solution = solve(mcmp(SKID, constraints=FEW))
    ends = solution.evaluation.ends
    assert (ends["crash"], ends["fire"]) == pytest.approx((0.01, 0.01), rel=1e-12)
    assert solution.failure_probability == pytest.approx(0.02, rel=1e-12)
    assert solution.prices["crash"] == pytest.approx(180.0)  # another 0.01 saves 0.2 * 9
    without = solve(replace(solution.problem, constraints={}))
    assert without.objective == pytest.approx(1.0)
    assert not certify(replace(solution, policy=without.policy)).accepted


SLIDE = [(0.5, "wreck", 4.0), (0.5, "ash", 4.0)]
FAR = skidding([(1.0, "verge", 1.0)], verge={"roll": [(0.5, "wreck", 0.0), (0.5, "ash", 0.0)]})
CRASHES = {"crash": end_probability("crash") <= 0.02}


@pytest.mark.parametrize(
    ("problem", "expected"),
    [
        # sliding costs 4, which who skids is charged once: 0.2 * 1.4 + 0.8 * 10
        (mcmp(skidding(SLIDE), constraints=FEW, charge_failing_step=True), 8.28),
        (mcmp(skidding(SLIDE), constraints=FEW), 8.2),
        # a fifth goes over; to slide is paid unless given up; anywhere 0.08 stop at once for free
        (mcmp(EDGE, constraints=CRASHES, give_up="attention"), 8.2),
        (mcmp(EDGE, constraints=CRASHES, give_up="dead_ends"), 8.22),
        (mcmp(EDGE, constraints=CRASHES, give_up="anywhere"), 7.4),
        # the wreck is three steps away: within two it is not reached, there is only no time left
        (mcmp(FAR, constraints=FEW, horizon=3), 8.2),
        (mcmp(FAR, constraints=FEW, horizon=2), 1.0),
        # who can spin for ever in the skid is never wrecked
        (mcmp(skidding(beside={"spin": [(1.0, "skid", 5.0)]}), constraints=FEW), 1.0),
        # who asks for the skid itself does not ask what comes after it
        (mcmp(SKID, constraints={"skid": end_probability("skid") <= 0.05} | FEW), 5.5),
    ],
)
def test_what_is_counted_and_charged(problem, expected: float) -> None:
    assert checked(problem) == pytest.approx(expected, rel=1e-12)


def test_policies_choose_after_failing() -> None:
    """Braking burns the car, steering wrecks it; both can be asked for."""
    ways = {"brake": [(1.0, "ash", 7.0)], "steer": [(1.0, "wreck", 7.0)]}
    model = skidding(beside=ways)
    crash = end_probability("crash")
    cheap = {"cost": expected_cost() <= 1.0}
    assert checked(LeastQuantity(model, "a", crash, constraints=cheap)) == pytest.approx(0.0)
    plain = LeastQuantity(SKID, "a", crash, constraints={"cost": expected_cost() <= 8.2})
    often = plain.constraints | {"goal": goal_probability() >= 0.9}
    assert checked(replace(plain, constraints=often)) == pytest.approx(0.01)
    assert checked(mcmp(model, constraints={"crash": crash >= 0.08})) == pytest.approx(1.0)
    with pytest.raises(InfeasibleError):
        solve(mcmp(SKID, constraints={"crash": crash >= 0.08}))
    safest = MaxProb(model, "a", constraints={"crash": crash >= 0.05})
    assert checked(safest) == pytest.approx(0.95)  # half go slow, half fast and steer


def test_criteria_of_costs_given_success() -> None:
    """A fifth goes fast: 0.18 succeed at 1 and 0.8 at 10."""
    assert checked(S3P(SKID, "a", 0.1, constraints=FEW)) == pytest.approx(8.18 / 0.98, rel=1e-9)
    mean = solve(CVaR(SKID, "a", 0.1, 0.1, constraints=FEW))
    share = 0.18 / 0.98
    assert mean.objective == pytest.approx((share - 0.1 + (1.0 - share) * 10.0) / 0.9, rel=1e-6)
    for level, expected in ((0.15, 1.0), (0.3, 10.0)):
        quantile = CostQuantile(SKID, "a", level, 0.1, constraints=FEW)
        assert solve(quantile).objective == pytest.approx(expected)
        assert solve(replace(quantile, constraints={})).objective == pytest.approx(1.0)


def test_a_discount_weighs_true_ends() -> None:
    """Skidding at time 1 and wrecked at time 2: 0.05 gamma^2 of each fast start."""
    gamma = 0.9
    problem = mcmp(SKID, 1.0, constraints=FEW, discount=gamma, give_up="dead_ends")
    found = evaluate(
        DeterministicPolicy.from_actions(SKID, {"a": "fast", "skid": "slide"}), problem
    )
    assert found.secondary_costs["crash"] == pytest.approx(0.05 * gamma**2, rel=1e-12)
    share = 0.01 / (0.05 * gamma**2)
    assert solve(problem).objective == pytest.approx(share + (1.0 - share) * 10.0, rel=1e-9)


def test_visits_and_secondary_costs_through_failure() -> None:
    """Both count until failing unless they are asked for through it."""
    model = skidding([(1.0, "verge", 1.0)], verge={"roll": [(1.0, "wreck", 3.0)]})
    fuel = {"a": {"fast": 1.0, "slow": 1.0}, "verge": {"roll": 5.0}}
    for until, through, bound in (
        (visits("verge"), visits("verge", through_failure=True), 0.02),
        (secondary_cost(fuel), secondary_cost(fuel, through_failure=True), 1.1),
    ):
        assert checked(mcmp(model, constraints={"c": until <= bound})) == pytest.approx(1.0)
        assert checked(mcmp(model, constraints={"c": through <= bound})) == pytest.approx(8.2)
    with pytest.raises(ModelError, match="through_failure"):
        visits("verge", through_failure="yes")


def test_what_never_ends_after_failing_is_kept_out_of() -> None:
    """Spinning burns fuel for ever; the slow road never does."""
    model = skidding([(1.0, "skid", 0.0)])
    fuel = {"skid": {"slide": 1.0}}
    limits = {"fuel": secondary_cost(fuel, through_failure=True) <= 100.0}
    assert checked(mcmp(model, constraints=limits)) == pytest.approx(10.0)
    fast = DeterministicPolicy.from_actions(model, {"a": "fast", "skid": "slide"})
    assert evaluate(fast, mcmp(model, constraints=limits)).secondary_costs["fuel"] == np.inf
    only = model_of({"a": {"go": [(0.5, "home", 1.0), (0.5, "b", 1.0)]},
                     "b": {"spin": [(1.0, "b", 0.0)]}})  # fmt: skip
    burning = {"fuel": secondary_cost({"b": {"spin": 1.0}}, through_failure=True) <= 100.0}
    with pytest.raises(InfeasibleError, match="without end") as refused:
        solve(mcmp(only, 1.0, constraints=burning, give_up="dead_ends"))
    assert refused.value.least_failure == pytest.approx(0.5)


@pytest.mark.parametrize(
    "problem",
    [
        mcmp(SKID),
        mcmp(SKID, constraints={"goal": goal_probability() >= 0.9}),
        mcmp(SKID, constraints={"seen": visits("wreck") <= 0.1}),
        mcmp(SKID, constraints={"cost": secondary_cost({"skid": {"slide": 1.0}}) <= 1.0}),
        mcmp(SKID, constraints={"skid": end_probability("skid") <= 0.05}),
        mcmp(EDGE, constraints=FEW, give_up="dead_ends"),
        MinCost(SKID, "a", constraints=FEW),
        MaxProb(SKID, "a"),
    ],
)
def test_nothing_is_built_where_nothing_counts_after_failing(problem) -> None:
    assert problem.unrolled is problem


@pytest.mark.parametrize("wait", [False, True])
def test_an_episode_goes_on_after_giving_up(wait: bool) -> None:
    """The one who drives sees actions, and ``failed`` from the step on that gives the goal up.

    On the edge the first action that avoids the goal slides; to wait is what was certified.
    """
    moves = {state: dict(actions) for state, actions in EDGES.items()}
    if wait:
        moves["edge"]["wait"] = [(1.0, "edge", 1.0)]
    model = model_of(moves, crash=["wreck"])
    most = end_probability("crash") <= (0.0 if wait else 0.1)
    solution = solve(mcmp(model, constraints={"crash": most}))
    assert solution.objective == pytest.approx(1.0)
    episode = acting_everywhere(solution.policy).start(0)
    assert episode.action("a") == "over"
    assert not episode.failed
    episode.observe("edge", 1.0)
    for _ in range(3 if wait else 1):
        action = episode.action("edge")
        assert action == ("wait" if wait else "slide")
        assert episode.failed
        episode.observe("edge" if wait else "wreck", 1.0)
    if not wait:
        assert episode.action("wreck") is None
        with pytest.raises(ModelError, match="over"):
            episode.observe("wreck", 0.0)


def test_policies_that_say_nothing_of_afterwards_end_where_they_fail() -> None:
    problem = mcmp(EDGE, constraints={"crash": end_probability("crash") <= 1.0})
    quits = DeterministicPolicy.from_actions(EDGE, {"a": "over", "edge": GIVE_UP})
    ends = evaluate(quits, problem).ends
    assert (ends["gave_up"], ends["crash"]) == pytest.approx((0.1, 0.0))
    slides = DeterministicPolicy.from_actions(EDGE, {"a": "over", "edge": "slide"})
    found = evaluate(slides, problem)
    assert found.ends["crash"] == pytest.approx(0.1)
    assert found.expected_cost == pytest.approx(1.0)  # the goal is lost on the edge
    silent = DeterministicPolicy.from_actions(SKID, {"a": "fast"})
    assert evaluate(silent, mcmp(SKID, constraints=FEW)).ends["dead_end"] == pytest.approx(0.1)
    told = DeterministicPolicy.from_actions(SKID, {"a": "fast", "skid": "slide"})
    assert evaluate(told, mcmp(SKID, constraints=FEW)).ends["crash"] == pytest.approx(0.05)
    assert evaluate(told, mcmp(SKID)).ends["dead_end"] == pytest.approx(0.1)


def test_a_program_has_columns_before_and_after_failing() -> None:
    problem = mcmp(EDGE, constraints={"crash": end_probability("crash") <= 0.02})
    program = problem.program()
    labels = {program.label(k)[:2] for k in range(program.process.n_pairs)}
    assert (("edge", "before failing"), ("give up", "slide")) in labels
    assert (("edge", "before failing"), "climb") in labels
    measure = program.solve()
    assert measure.objective == pytest.approx(8.2, rel=1e-9)
    assert measure.duals["crash"] == pytest.approx(90.0)
    for policy in (measure.mixed_policy(), measure.randomised_policy()):
        found = evaluate(policy, problem)
        assert found.objective == pytest.approx(8.2, rel=1e-9)
    assert program.columns("edge", "climb")
    assert len(program.columns("edge")) == 4


def test_a_program_names_what_it_does_not_tell_apart() -> None:
    plain, limited = mcmp(SKID).program(), mcmp(SKID, constraints=FEW).program()
    with pytest.raises(ModelError, match="after failing"):
        plain.expression(end_probability("crash"))
    for quantity in (end_probability("crash"), end_probability("fire", "goal"), visits("skid")):
        coefficients, constant = limited.expression(quantity)
        assert constant == 0.0
        assert coefficients @ limited.solve().visits > 0.0
    seen = plain.expression(visits("skid"))[0] @ plain.solve().visits
    assert seen == pytest.approx(0.1)
    with pytest.raises(ModelError, match="after failing"):
        limited.expression(end_probability("skid"))


@pytest.mark.parametrize("horizon", [None, 4])
def test_files_hold_what_is_done_after_failing(horizon, tmp_path) -> None:
    problem = mcmp(SKID, constraints=FEW, horizon=horizon)
    solution = solve(problem)
    save_policy(solution.policy, tmp_path / "policy.npz")
    found = load_policy(tmp_path / "policy.npz", SKID)
    assert evaluate(found, problem).ends["crash"] == pytest.approx(0.01)
    save_solution(solution, tmp_path / "solution.npz")
    assert certify(load_solution(tmp_path / "solution.npz", problem)).accepted
    write_controller(solution.policy, tmp_path / "controller.json")
    controller, ends = Controller(tmp_path / "controller.json"), {"wreck": 0, "ash": 0, "home": 0}
    draw = np.random.default_rng(3)
    for seed in range(3_000):
        controller.reset(seed)
        state, moves = "a", {"fast": ["home"] * 9 + ["skid"], "slow": ["home"]}
        while (action := controller.action(state)) is not None:
            assert controller.failed == (state == "skid")
            state = str(draw.choice(moves[action] if state == "a" else ["wreck", "ash"]))
            controller.observe(state, {"fast": 1.0, "slow": 10.0, "slide": 0.0}[action])
        ends[state] += 1
    assert abs(ends["wreck"] / 3_000 - 0.01) < 4.0 * np.sqrt(0.01 / 3_000)
    randomised = solution.randomised_policy
    assert randomised.model is SKID
    assert evaluate(randomised, problem).objective == pytest.approx(8.2, rel=1e-9)


def test_a_way_to_the_goal_that_may_never_end_after_failing_is_none():
    """What falls into the bog stays there, so that only what cannot fall into it may be done."""
    fork = {"risk": [(0.5, "ditch", 1.0), (0.5, "home", 1.0)], "stop": [(1.0, "wall", 1.0)]}
    model = model_of(
        {
            "start": {"go": [(0.8, "home", 1.0), (0.2, "fork", 1.0)]},
            "fork": fork,
            "ditch": {"sink": [(1.0, "bog", 1.0)]},
            "bog": {"rest": [(1.0, "bog", 1.0)]},
            "wall": {},
        }
    )
    dry = {"dry": visits("bog", through_failure=True) <= 0.2}
    for budget in (None, 0.5, 1.0):
        solution = solve(S3P(model, "start", budget, constraints=dry))
        assert solution.objective == pytest.approx(1.0, rel=1e-12)
        assert solution.failure_probability == pytest.approx(0.2, rel=1e-12)
        assert certify(solution).gap <= 1e-9
    worth = solve(GUBS(model, "start", lambda cost: np.exp(-cost), 0.5, constraints=dry))
    assert worth.objective == pytest.approx(0.8 * (np.exp(-1.0) + 0.5), rel=1e-9)
    assert compiled_constrained(worth.problem.unrolled).facts.typical_cost == pytest.approx(1.0)
