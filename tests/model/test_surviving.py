"""Going on for so many steps as a goal."""

from pathlib import Path

import numpy as np
import pytest

from formulations import MCMP, MaxProb
from small_models import model_of
from ssp_lp import SSP, ModelError, certify, evaluate, simulate, solve, within_steps
from ssp_lp.io import load_policy, save_policy


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
