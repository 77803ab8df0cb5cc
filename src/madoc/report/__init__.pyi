from .page import leave_report as leave_report
from .page import write_comparison as write_comparison
from .page import write_report as write_report
