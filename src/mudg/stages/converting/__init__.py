"""Parts of ``mudg convert``."""
