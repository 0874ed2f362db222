"""The neutral layout."""
