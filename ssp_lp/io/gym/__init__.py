"""Models of the environments of others, and policies back in them."""
