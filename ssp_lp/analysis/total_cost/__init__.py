"""The law of a policy's total cost."""
