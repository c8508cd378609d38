"""Linear programs as arrays, and LP solvers; independent of processes."""
