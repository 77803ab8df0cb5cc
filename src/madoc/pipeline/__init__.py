"""The stages of the main job with their files, and `run_all`, which does them one after another."""

from madoc.pipeline.auto_stage import AUTO, AUTO_BUDGET, calibrate_auto_in
from madoc.pipeline.calibration_stage import BUDGET, HOLDOUT, CalibrationOrder, calibrate_in, read_calibration
from madoc.pipeline.data_stage import Source, fingerprint, load_source, record_named, split_name
from madoc.pipeline.evaluation_stage import evaluate_folder
from madoc.pipeline.export_stage import export_run
from madoc.pipeline.learning_stage import PolicyOrder, learn_in
from madoc.pipeline.report_stage import leave_report
from madoc.pipeline.selftest_stage import selftest_of
from madoc.pipeline.whole import Plan, run_all

__all__ = [
    "AUTO",
    "AUTO_BUDGET",
    "BUDGET",
    "HOLDOUT",
    "CalibrationOrder",
    "Plan",
    "PolicyOrder",
    "Source",
    "calibrate_auto_in",
    "calibrate_in",
    "evaluate_folder",
    "export_run",
    "fingerprint",
    "learn_in",
    "leave_report",
    "load_source",
    "read_calibration",
    "record_named",
    "run_all",
    "selftest_of",
    "split_name",
]
