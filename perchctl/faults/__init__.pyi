from .catalogue import FAULTS as FAULTS
from .catalogue import select_faults as select_faults
from .flight import fly_fault_in_folder as fly_fault_in_folder
from .results import FaultResult as FaultResult
from .results import fault_summary as fault_summary
from .results import fault_table as fault_table
