"""Quantities of an occupation measure, constraints on them, and the rows that these become."""
