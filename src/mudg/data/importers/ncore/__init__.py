"""NCore recordings (version 4): the importer, and the check of their files before they are read."""
