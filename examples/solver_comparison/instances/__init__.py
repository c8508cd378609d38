"""What is solved: instances by name, and their models."""
