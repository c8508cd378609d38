"""Compiled searches on graphs."""
