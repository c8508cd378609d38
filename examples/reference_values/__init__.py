"""Certified values of published models, for tests of other tools."""
