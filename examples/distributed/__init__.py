"""Models on the ranks of PETSc, over MPI."""
