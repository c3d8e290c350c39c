"""Finds a car's pose to the centimetre from one LiDAR and a mesh map that it builds itself.

Frames: points are in the frame of the lidar (z up), maps and results in that of the map. Poses are 4 x 4
matrices that take points from the lidar to the map, ``p_map = map_from_lidar @ p_lidar``. Units: metres, radians,
seconds. Keywords after those of a signature are keys of the program's configuration files
(``fpmcl config localize --full``), with their units and defaults.
"""

from ._fpmcl import *  # noqa: F403
from ._fpmcl import __all__, __version__  # noqa: F401
