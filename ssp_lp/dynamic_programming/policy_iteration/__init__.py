"""Policy iteration on substochastic processes."""
