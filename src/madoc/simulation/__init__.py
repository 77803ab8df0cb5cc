"""Simulators: parameters bound to a system, systems stepped over two batch axes."""
