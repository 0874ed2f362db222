"""Floor 2: pure tensor functions. No files, no configuration loading, no parameters."""
