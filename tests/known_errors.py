"""Prediction errors of a filter, given by hand."""

import numpy as np

from madoc.identification.innovations import Correction, Innovations


def known(errors):
    """Innovations with these whitened errors, as the covariance of predictions is 1."""
    rows, channels = errors.shape[1:-1], errors.shape[-1]
    one, none = np.broadcast_to(np.eye(channels), (*rows, channels, channels)), np.zeros((*rows, 1, channels))
    correction = Correction(one, one, none, none, np.ones((*rows, channels)))
    nothing = np.zeros((*errors.shape[1:3], 0))
    return Innovations(
        errors, correction, np.ones(errors.shape[:2], bool), errors, 0, np.ones(channels), nothing, nothing
    )
