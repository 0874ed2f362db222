"""Settings of the verbs of this room."""
