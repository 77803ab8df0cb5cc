"""A log and a model compared before any calibration."""

from madoc.diagnosis.channels import refuse_fatal
from madoc.diagnosis.diagnosis import Diagnosis, check, tables, to_json

__all__ = ["Diagnosis", "check", "refuse_fatal", "tables", "to_json"]
