"""Parts of ``stages/annotate.py``."""
