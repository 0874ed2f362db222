"""Labellers: semantic classes and sky from images, LiDAR and boxes."""
