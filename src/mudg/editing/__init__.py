"""Drives changed as a script says: on fitted scenes, clouds, images and sweeps."""
