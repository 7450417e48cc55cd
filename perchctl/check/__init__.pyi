from .capture import comparison_rows as comparison_rows
from .profile import profile_rows as profile_rows
from .profile import warnings_before_flight as warnings_before_flight
from .row import Row as Row
from .row import Verdict as Verdict
from .session import CheckScope as CheckScope
from .session import check as check
from .session import scan_rows as scan_rows
