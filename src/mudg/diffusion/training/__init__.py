"""Training of diffusion models on one process or many."""
