"""The multi-modal diffusion model: condition, network, training, adaptation, sampling."""
