"""The shortest way in: one model, one criterion, one answer."""
