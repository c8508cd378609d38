"""Small random models solved in exact fractions, by enumeration of their policies."""
