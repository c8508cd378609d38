"""Facts about a model's graph, decided by searches."""
