"""Instances of the comparison by name, and their models."""
