"""Drawn problems with secondary costs of their outcomes, and limits on them."""

import numpy as np
from hypothesis import strategies as st

from formulations import CostLimit
from strategies import problems


@st.composite
def charged_problems(draw, most_rows=3):
    """A problem and one to three secondary costs of its outcomes, mostly at odds with the cost."""
    drawn = draw(problems(most_live=3, most_actions=3))
    amounts = st.sampled_from([0, 1, 0, 2, 5])
    charges = []
    for _ in range(draw(st.integers(1, most_rows))):
        against = draw(st.sampled_from([3, 5, 0]))
        charges.append(
            {
                state: {
                    action: [max(against - cost, 0) + draw(amounts) for _, _, cost in outcomes]
                    for action, outcomes in acts.items()
                }
                for state, acts in drawn.choices.items()
            }
        )
    return drawn, charges


def by_outcome(model, charge):
    """A secondary cost as an array, [outcomes]."""
    costs = []
    for state in model.states:
        for outcomes in charge.get(state, {}).values():
            costs += outcomes
    return np.array(costs, dtype=float)


def limits_of(model, charges, bounds):
    """Limits named r0, r1, ..."""
    return {
        f"r{k}": CostLimit(by_outcome(model, charge), bound)
        for k, (charge, bound) in enumerate(zip(charges, bounds, strict=True))
    }
