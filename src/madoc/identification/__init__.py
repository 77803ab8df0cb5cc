"""What diagnosis, calibration and verdict share: residuals of simulated systems, and the information in a log."""
