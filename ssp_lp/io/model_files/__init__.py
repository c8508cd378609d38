"""Readers and writers of model files of other tools."""
