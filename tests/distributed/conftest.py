"""The script for mpiexec is no module of tests: it asks for MPI when it is imported."""

collect_ignore = [
    "on_every_rank.py",
    "on_partitioned_models.py",
    "on_a_checkpoint.py",
    "on_drawn_problems.py",
]
