"""Augmentations of a model, as substochastic processes, on which criteria are solved."""
