"""Measurement of seconds and memory, in a separate process for each solver."""
