"""Inner loops compiled by numba; import its modules only where ``accelerated`` returns true."""
