"""The model checker Storm: models from it and to it, schedulers as it writes them."""
