"""The best single deterministic policy, by mixed-integer programs."""
