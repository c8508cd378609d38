"""Parts of model files: their text, what they hold, and how it becomes a model and back."""
