import sys
from pathlib import Path

# Own robots and their logs are made beside the tests of the readers.
sys.path.append(str(Path(__file__).parents[1] / "data"))
