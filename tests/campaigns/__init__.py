"""Checks of many drawn models: against exact fractions, and on models of every structure."""
