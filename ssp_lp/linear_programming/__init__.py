"""Linear programs as arrays, and the solvers they are handed to; nothing here knows a process."""
