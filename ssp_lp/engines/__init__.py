"""Engines: column generation with its oracles, and the full linear program."""
