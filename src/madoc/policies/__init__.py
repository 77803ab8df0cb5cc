"""Policy learners: from a calibrated simulator to a policy. One file a learner."""
