"""The full-size network of the published system, under its own key names."""
