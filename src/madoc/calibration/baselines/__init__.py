"""Calibrators that Madoc and least squares are compared with, and what their searches share."""
