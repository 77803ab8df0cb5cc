"""Least squares: the parameters whose next states lie nearest to the logged ones, and how sure one may be."""
