"""Answers checked anew: certificates, and methods held against each other."""
