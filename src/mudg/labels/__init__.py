"""Depth, classes, sky and dynamic objects of recorded frames."""
