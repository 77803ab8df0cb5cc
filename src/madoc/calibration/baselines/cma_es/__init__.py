"""CMA-ES as a black-box yardstick: on one-step errors, or on distances between unordered observations."""
