"""Models of continuous worlds: a box of coordinates, cut into cells, and a step function."""
