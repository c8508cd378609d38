"""Methods: each solves a problem to a certified solution."""
