"""The small multi-modal diffusion model: network, codec, refiner, and the model that holds them."""
