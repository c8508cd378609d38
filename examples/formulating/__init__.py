"""Posing problems: a task of one's own as a memory, and every criterion on one model."""
