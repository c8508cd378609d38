"""The solvers of the comparison: the library, HiGHS and Storm behind one function, `prepare`."""
