"""Passes over a process: what most of a solver's time is spent on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Work:
    """Passes over a process: what most of a pricing problem's time is spent on."""

    backups: int = 0  # over all pairs
    products: int = 0  # over one pair per state

    def __add__(self, other: Work) -> Work:
        """Both together."""
        return Work(self.backups + other.backups, self.products + other.products)
