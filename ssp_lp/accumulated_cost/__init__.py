"""The total cost of a run: totals, charges, the process, sweeps over it, and its law."""
