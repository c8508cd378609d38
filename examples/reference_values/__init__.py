"""Certified values of published models, for others to test against."""
