"""Published methods for comparison: what each adds to the common fit."""
