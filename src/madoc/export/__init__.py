"""A calibration out of Madoc: the model, what changed in it, ranges to randomize in, a policy for other runtimes."""
