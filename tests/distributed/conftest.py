"""The scripts for mpiexec are no modules of tests: they ask for MPI when they are imported."""

from pathlib import Path

collect_ignore = [path.name for path in Path(__file__).parent.glob("on_*.py")]
