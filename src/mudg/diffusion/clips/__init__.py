"""Clips for the diffusion model: conditions and targets, from generated cities and from driving logs."""
