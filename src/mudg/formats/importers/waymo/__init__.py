"""Waymo Open Dataset, both file formats."""
