"""A problem as processes and pricing problems, with the refinement of what is truncated."""
