"""Total costs: the multiples of a unit, the sums that can occur, and grids."""
