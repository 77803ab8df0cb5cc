"""Blocks that algorithms share: networks, distributions, replay, losses."""
