"""Scores of views against truth, one by one and as sets."""
