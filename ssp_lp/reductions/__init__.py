"""Problems that are solved by solving several restated problems."""
