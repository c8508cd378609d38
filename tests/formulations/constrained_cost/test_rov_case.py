"""The rover of QComp 2023 as a C-SSP: ten tasks' energy against their time (a case without a goal).

Energy falls by 6/35 for every unit of time, from the most hurried runs on: the lotteries between
the hurried and the slow way of one and the same task. Storm 2.0's multi-objective check gives
46.857142857 at time 60, 45.142857143 at 70.
"""

from fractions import Fraction

import pytest

from cases import raw_case
from formulations import ConstrainedCost, CostLimit, MinCost
from ssp_lp import SSP, InfeasibleError, certify, solve


def read(cost, other):
    """The model with one of its rewards as cost, and another by state and action."""
    raw = raw_case("qcomp23_rov_B10")
    (end,) = raw["labels"]["deadlock"]
    choices, spent = {}, {}
    for state, listed in enumerate(raw["choices"]):
        if state == end:
            continue
        choices[state], spent[state] = {}, {}
        for position, choice in enumerate(listed):
            action, rewards = f"{position}:{choice['name']}", choice["rewards"]
            paid = Fraction(rewards.get(cost, 0))
            choices[state][action] = [(Fraction(p), t, paid) for t, p in choice["to"]]
            spent[state][action] = float(Fraction(rewards.get(other, 0)))
    return SSP.from_transitions(choices, goal={end}), spent


@pytest.fixture(scope="module")
def rover():
    """Energy is the cost, time is limited."""
    return read("energy", "time")


@pytest.mark.parametrize("method", ["columns", "lp"])
@pytest.mark.parametrize("bound", [50, 55, 60, 70, 100])
def test_time_is_bought_with_energy(rover, bound, method):
    model, time = rover
    problem = ConstrainedCost(model, 0, limits={"time": CostLimit(time, bound)})
    solution = solve(problem, method)
    assert solution.objective == pytest.approx(40 + 6 / 35 * (100 - bound), rel=1e-12)
    assert solution.gap <= 1e-12
    assert certify(solution).accepted
    assert solution.secondary_costs["time"] == pytest.approx(bound, rel=1e-12)
    if bound < 100:
        assert solution.prices["time"] == pytest.approx(6 / 35, rel=1e-9)
        assert len(solution.policy.policies) == 2


def test_nobody_is_faster_than_the_fastest(rover):
    model, time = rover
    fastest = solve(MinCost(read("time", "energy")[0], 0)).objective
    problem = ConstrainedCost(model, 0, limits={"time": CostLimit(time, fastest - 1.0)})
    with pytest.raises(InfeasibleError, match=f"'time' is at least {fastest:g}"):
        solve(problem)
