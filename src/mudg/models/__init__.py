"""Floor 3: everything that holds parameters. Knows no file."""
