from .told import ReportedFlight as ReportedFlight
from .write import REPORT_SUFFIXES as REPORT_SUFFIXES
from .write import flight_counts_text as flight_counts_text
from .write import report_path_of as report_path_of
from .write import session_path_of as session_path_of
from .write import write_report as write_report
