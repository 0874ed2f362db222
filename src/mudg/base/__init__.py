"""The words of the package: types, geometry, seeds, errors, configuration and the on-disk store."""
