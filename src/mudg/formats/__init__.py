"""Logs and Gaussians of other programs: importers, exporters, Gaussian files."""
