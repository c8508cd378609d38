"""Substochastic processes: the augmentations of a model that a criterion is solved on."""
