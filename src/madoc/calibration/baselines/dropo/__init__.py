"""DROPO and E-DROPO: the distribution of parameters under which the logged next states are likely."""
