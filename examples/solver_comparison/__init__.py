"""This library's engines beside their peers: `compare_solvers` runs them all."""
