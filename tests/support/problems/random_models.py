"""Random models of some dozen states, as the library's and as the references' model."""

import numpy as np

from references.chain import plain_model
from ssp_lp import SSP


def random_choices(rng, n_states, free_share=0.3):
    """Sparse actions over a ring of states with shortcuts, pits and one goal; integer costs."""
    states = [f"s{k}" for k in range(n_states)]
    choices = {}
    for k, state in enumerate(states):
        choices[state] = {}
        for action in range(rng.integers(1, 4)):
            near = [states[(k + int(step)) % n_states] for step in rng.integers(-2, 5, size=3)]
            other = rng.choice(["goal", "pit", "swamp", *near], p=[0.15, 0.1, 0.05, 0.3, 0.2, 0.2])
            chance = int(rng.integers(1, 20)) / 20
            costs = [0 if rng.random() < free_share else int(rng.integers(1, 4)) for _ in range(2)]
            choices[state][action] = [
                (chance, near[0], costs[0]),
                (1 - chance, str(other), costs[1]),
            ]
    choices["pit"] = {}
    choices["swamp"] = {"wade": [(1.0, "swamp", 2)]}
    return choices


def drawn_model(seed, n_states):
    """Both forms of one random model."""
    choices = random_choices(np.random.default_rng(seed), n_states)
    model = SSP.from_transitions(choices, goal={"goal"}, treat_actionless_as_dead_ends=True)
    return model, plain_model(choices, {"goal"})
