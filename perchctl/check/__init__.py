"""What can be known on the ground before a flight: one row for each question.

row: a row, and tables of judges that answer questions by their names. vehicle, camera, capture,
profile: the rows by subject. rehearsal: the flight loop's senses on live pictures.
session: the whole check, in the order in which its rows come.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
