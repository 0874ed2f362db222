"""The dynamic Gaussian scene: model, nodes, fit loop, renders, storage."""
