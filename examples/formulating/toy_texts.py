"""From `gym.make` to a certified policy, simulated in the environment: three toy texts.

    python examples/formulating/toy_texts.py

The lake and the taxi have limits on steps, the cliff has none and is given one. The certified
failure lies in the confidence interval of the simulation.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable

import gymnasium as gym

from ssp_lp import MCMP, Solution, certify, solve
from ssp_lp.io import RolloutReport, from_gymnasium, rollout

EPISODES = 2000
END_OF_CLIFF = 47


def frozen_lake(episodes: int = EPISODES) -> tuple[Solution, RolloutReport]:
    """Cross the ice within 100 steps, drowning or late in at most 40 % of the episodes."""
    env = gym.make("FrozenLake-v1", map_name="8x8")
    world = from_gymnasium(env)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.4))
    return solution, rollout(env, solution.policy, episodes=episodes, seed=0)


def cliff_walking(episodes: int = EPISODES) -> tuple[Solution, RolloutReport]:
    """Walk along the slippery cliff in 100 steps, late in at most 10 % of the episodes."""
    env = gym.make("CliffWalkingSlippery-v1", max_episode_steps=100)
    world = from_gymnasium(env, goal=lambda state: state == END_OF_CLIFF)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.1))
    return solution, rollout(env, solution.policy, episodes=episodes, seed=0)


def taxi(episodes: int = EPISODES) -> tuple[Solution, RolloutReport]:
    """Drive passengers within 200 steps at the least cost; one run in twenty may fail."""
    env = gym.make("Taxi-v4")
    world = from_gymnasium(env)
    solution = solve(MCMP(world.model, world.start, failure_budget=0.05))
    return solution, rollout(env, solution.policy, episodes=episodes, seed=0)


TASKS: dict[str, Callable[[int], tuple[Solution, RolloutReport]]] = {
    "FrozenLake 8x8": frozen_lake,
    "CliffWalking, slippery": cliff_walking,
    "Taxi": taxi,
}


def main() -> None:
    """Solve and simulate all tasks."""
    for name, task in TASKS.items():
        solution, report = task(EPISODES)
        proof = "certified" if certify(solution).accepted else "not certified"
        print(f"{name}: failure {solution.failure_probability:.4f}, {proof}")
        print(report.summary())


if __name__ == "__main__":
    ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter).parse_args()
    main()
