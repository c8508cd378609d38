"""Pricing problems: a deterministic policy of least reduced cost, and the dual bound there."""
