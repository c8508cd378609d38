"""What is shown: rows, a table, a plot."""
