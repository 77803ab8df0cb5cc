"""Logged data: `load` reads any known format into a `Dataset`, `save` writes Madoc's own."""

from madoc.data.dataset import Dataset, logged_states, subsample
from madoc.data.formats import FORMATS, Format, load
from madoc.data.native import save
from madoc.data.validation import validate

__all__ = ["FORMATS", "Dataset", "Format", "load", "logged_states", "save", "subsample", "validate"]
