"""The dynamic Gaussian scene: nodes, motion, densification, appearance."""
