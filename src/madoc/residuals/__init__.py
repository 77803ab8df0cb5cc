"""How far a system is from the log, and how that changes with its parameters: what diagnosis and calibration share."""
