"""Pure tensor functions. No files, no configuration loading, no parameters."""
