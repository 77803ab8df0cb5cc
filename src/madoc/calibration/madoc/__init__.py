"""Madoc: Multi-Agent Domain Calibration (Jiang et al. 2024)."""
