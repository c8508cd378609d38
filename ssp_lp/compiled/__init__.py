"""Inner loops compiled by numba; import a module of this package only where ``accelerated``."""
