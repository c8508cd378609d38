"""The Bayes-adaptive iteration of the paper (sections 3.2 to 3.4)."""
