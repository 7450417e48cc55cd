from .plot import plot_replay as plot_replay
from .run import check_readable as check_readable
from .run import replay as replay
from .sense import Picture as Picture
from .told import replay_lines as replay_lines
from .told import replay_record as replay_record
from .whatif import changed_gates as changed_gates
from .whatif import pose_changes as pose_changes
