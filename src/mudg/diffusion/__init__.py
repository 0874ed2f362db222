"""The multi-modal diffusion model: condition, network, training, sampling."""
