"""Substochastic processes: augmentations of a model, on which criteria are solved."""
