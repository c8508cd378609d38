"""Several rows at once: phase 1, the search, its proof, and the solution."""
