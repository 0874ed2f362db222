"""Parts of ``mudg score``."""
