from collections.abc import Callable

from . import calibration as calibration
from . import data as data
from . import identification as identification
from . import policies as policies
from . import robots as robots
from . import runs as runs
from . import simulation as simulation
from . import tasks as tasks
from .calibration import CalibrationProblem as CalibrationProblem
from .calibration import CalibrationResult as CalibrationResult
from .calibration import CmaEs as CmaEs
from .calibration import Droid as Droid
from .calibration import Dropo as Dropo
from .calibration import LeastSquares as LeastSquares
from .calibration import Madoc as Madoc
from .calibration import Npe as Npe
from .calibration import Oted as Oted
from .calibration import Uncalibrated as Uncalibrated
from .calibration import calibrate as calibrate
from .calibration.madoc.agents import AgentSettings as AgentSettings
from .data import Dataset as Dataset
from .data import Disturbance as Disturbance
from .data import disturb as disturb
from .errors import MadocError as MadocError
from .evaluation import evaluate as evaluate
from .numpy_policy import NumpyPolicy as NumpyPolicy
from .parameters import Parameter as Parameter
from .parameters import ParameterSpace as ParameterSpace
from .pipeline import CalibrationOrder as CalibrationOrder
from .pipeline import RunOrder as RunOrder
from .pipeline import Search as Search
from .pipeline import Source as Source
from .pipeline import calibrate_in as calibrate_in
from .pipeline import read_calibration as read_calibration
from .pipeline import record as record
from .pipeline import run_all as run_all
from .policies import BC as BC
from .policies import CQL as CQL
from .policies import H2O as H2O
from .policies import MOREC as MOREC
from .policies import SAC as SAC
from .policies import FastSAC as FastSAC
from .policies import NormalParameters as NormalParameters
from .policies import PolicyProblem as PolicyProblem
from .policies import UniformParameters as UniformParameters
from .policies import learn_policy as learn_policy
from .policies import load_policy as load_policy
from .policies import save_policy as save_policy
from .runs.run_folder import RunFolder as RunFolder
from .verdict import assess as assess

__version__: str
ENVIRONMENTS: dict[str, str]
EPISODE_STEPS: int

def lazily(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]: ...
