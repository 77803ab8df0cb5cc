"""Calibrators: from logged data to parameters. One file a method."""
