"""Who solves it: the library, HiGHS and Storm behind one function, `prepare`."""
