"""Neural posterior estimation on free rollouts: a flow conditioned on what rows tell of the parameters."""
