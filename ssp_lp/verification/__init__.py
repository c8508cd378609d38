"""Verification of solutions: certificates, and the comparison of methods."""
