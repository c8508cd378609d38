"""Reports of the comparison: rows, a table, a plot."""
