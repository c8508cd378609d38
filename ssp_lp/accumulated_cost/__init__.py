"""Accumulated cost: totals, charges, the layered process, its sweeps, and the law of costs."""
