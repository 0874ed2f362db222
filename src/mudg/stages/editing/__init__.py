"""Parts of ``mudg edit``."""
