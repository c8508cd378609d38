"""Oracles: dynamic programming on a process at a given price of failure."""
