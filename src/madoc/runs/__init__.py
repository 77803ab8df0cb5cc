"""Runs of any method: the loop under a budget, checkpoints, the run folder, files, interruption and progress."""
