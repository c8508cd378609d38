"""Problems solved through several calls of a method on restated problems."""
