"""Compiled solution of the equations of chains."""
