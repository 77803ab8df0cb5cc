"""Madoc: calibrate a simulator to logged data, learn a policy there, show that it works in the target."""
