"""Solution of a problem by solving several restated problems."""
