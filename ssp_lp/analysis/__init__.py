"""What a policy does: evaluation, simulation, the law of its total cost."""
