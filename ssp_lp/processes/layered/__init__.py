"""Processes over states and accumulated cost, one layer per total."""
