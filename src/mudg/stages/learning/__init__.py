"""Parts of ``stages/learn.py``."""
