"""One floor under diagnosis, calibration and verdict: how far systems are from a log, and what the log can tell."""
