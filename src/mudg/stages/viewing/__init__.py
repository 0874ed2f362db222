"""Parts of ``mudg view``: the server on this machine and the exact frames behind it."""
