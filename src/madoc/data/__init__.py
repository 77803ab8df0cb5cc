"""Logged data: `load` reads any known format into a `Dataset`, `save` writes Madoc's own."""

from madoc.data.dataset import Dataset, Disturbance, subsample, typical_change
from madoc.data.disturbance import disturb, hide_velocities, observed_task
from madoc.data.formats import FORMATS, Format, load
from madoc.data.native import save
from madoc.data.validation import validate

__all__ = [
    "FORMATS",
    "Dataset",
    "Disturbance",
    "Format",
    "disturb",
    "hide_velocities",
    "load",
    "observed_task",
    "save",
    "subsample",
    "typical_change",
    "validate",
]
