from .errors import OutlapError as OutlapError
from .simulator.simulator import Simulator as Simulator
from .track.catalog import load_track as load_track
from .track.track import Track as Track

__version__: str
