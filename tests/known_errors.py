"""Prediction errors of a filter, given by hand."""

import numpy as np

from madoc.identification.ensembles import Correction, Innovations


def known(errors):
    """Innovations with these whitened errors, as the covariance of predictions is 1."""
    rows, channels = errors.shape[1:-1], errors.shape[-1]
    one, none = np.broadcast_to(np.eye(channels), (*rows, channels, channels)), np.zeros((*rows, 1, channels))
    correction = Correction(one, one, none, none, np.ones((*rows, channels)))
    return Innovations(errors, correction, np.ones(errors.shape[:2], bool), errors, 0)
