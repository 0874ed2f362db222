"""Depth networks that complete LiDAR depth."""
