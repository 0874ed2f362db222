"""``mudg bench``: methods and models measured against exact truth."""
