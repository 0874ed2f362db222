"""Floor 3: bytes to types and back. Knows no model."""
