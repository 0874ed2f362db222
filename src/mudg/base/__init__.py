"""Floor 1: the words of the package. Types, geometry, seeds, errors, configuration and the on-disk store."""
