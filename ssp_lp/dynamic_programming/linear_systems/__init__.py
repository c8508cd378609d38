"""The equations of a policy's chain, ``(I - P) x = b``, solved and verified."""
