"""Restated problems that several calls of a method answer."""
