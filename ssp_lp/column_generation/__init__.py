"""Column generation (Dantzig-Wolfe): policies are the columns, a restricted master mixes them."""
