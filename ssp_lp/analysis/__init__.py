"""Analysis of a policy: evaluation, simulation, the law of its total cost."""
