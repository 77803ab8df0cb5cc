"""A log and a model compared before any calibration."""

from madoc.diagnosis.channels import Channel, refuse_fatal
from madoc.diagnosis.diagnosis import Diagnosis, check
from madoc.diagnosis.excitation import Excitation
from madoc.diagnosis.explanation import Explanation
from madoc.diagnosis.words import tables, to_json

__all__ = ["Channel", "Diagnosis", "Excitation", "Explanation", "check", "refuse_fatal", "tables", "to_json"]
