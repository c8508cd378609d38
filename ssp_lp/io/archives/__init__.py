"""What files of policies and solutions are made of."""
