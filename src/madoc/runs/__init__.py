"""What a run is made of: the loop under a budget, checkpoints, the run folder, files, interruption and progress."""
