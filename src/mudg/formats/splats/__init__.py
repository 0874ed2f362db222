"""Files of Gaussians that other programs read and write: one module per format, listed in ``formats.py``.

``cloud.py`` says what the Gaussians of a file are. Writers are functions to bytes; readers check lengths and sizes
before they allocate, and refuse what is damaged with ``InputError``.
"""
