"""How it is measured: a process for each solver, its seconds and its memory."""
