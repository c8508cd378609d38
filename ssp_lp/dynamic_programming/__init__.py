"""Dynamic programming on substochastic processes: equations of policies, improvement, bounds."""
