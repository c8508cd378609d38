"""Risk of the total cost given success: its quantile and its conditional value at risk."""
