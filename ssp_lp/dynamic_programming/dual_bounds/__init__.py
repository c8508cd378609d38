"""Checked sub-solutions: lower bounds that hold for every policy."""
