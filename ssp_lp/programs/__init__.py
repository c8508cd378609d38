"""Occupation-measure linear programs."""
