"""This library's methods beside their peers: `compare_solvers` runs them all."""
