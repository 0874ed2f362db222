"""Parts of ``stages/fit.py``."""
