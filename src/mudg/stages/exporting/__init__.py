"""Parts of ``mudg export``, and of ``mudg asset import``."""
