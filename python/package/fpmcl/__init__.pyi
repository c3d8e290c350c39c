from collections.abc import Iterable, Iterator
from os import PathLike
from typing import Any, Literal, Optional, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

__version__: str
__all__: list[str]

_Path = Union[str, PathLike[str]]
_Backend = Literal["auto", "cpu", "gpu"]
_State = Literal["searching", "tracking", "lost"]
_Scans = Union[Recording, Iterable[Union[Scan, ArrayLike]]]

class Error(Exception):
    """An error of the library, with its message: what happened, which value or file, and what to do."""

class Scan:
    """Points of one sweep in the frame of the lidar; immutable.

    ``points``: (N, 3), copied once [m]. ``times``: (N,), when each point was measured, after the moment of the pose [s]; by
    them a scan is deskewed. ``time``: the moment of the pose, from any origin [s]. ``intensities``: (N,), 0 to 1.
    ``rings``: (N,), number of the beam of each point. Raises ValueError if lengths differ.
    """

    def __new__(
        cls,
        points: ArrayLike,
        times: Optional[ArrayLike] = None,
        *,
        time: Optional[float] = None,
        intensities: Optional[ArrayLike] = None,
        rings: Optional[ArrayLike] = None,
    ) -> Scan: ...
    @property
    def points(self) -> NDArray[np.float32]:
        """Points in the frame of the lidar, (N, 3) float32 [m]; read-only, not a copy."""

    @property
    def intensities(self) -> Optional[NDArray[np.float32]]:
        """Reflectance of each point, (N,) float32, 0 to 1; None if unknown."""

    @property
    def times(self) -> Optional[NDArray[np.float32]]:
        """When each point was measured, after the moment of the pose, (N,) float32 [s]; None if unknown."""

    @property
    def rings(self) -> Optional[NDArray[np.uint16]]:
        """Number of the beam of each point, (N,) uint16; None if unknown."""

    @property
    def time(self) -> Optional[float]:
        """The moment of the pose [s]; None if unknown."""

    @property
    def number(self) -> Optional[int]:
        """Number of the scan in its recording; None if it is not from one."""

    @property
    def pose(self) -> Optional[NDArray[np.float64]]:
        """Given pose in the frame of the recording, (4, 4); None if there is none."""

    def __len__(self) -> int:
        """Number of points."""

class Sensor:
    """What a sensor is: its beams, limits of range, own car and height, inferred from scans."""

    @property
    def beams(self) -> Optional[int]:
        """Number of beams; None of a sensor without rows."""

    @property
    def height(self) -> Optional[float]:
        """Height above the ground [m]; None where too little ground is visible."""

    @property
    def own_car(self) -> Optional[list[float]]:
        """Rectangle with returns of the own car: x_min, x_max, y_min, y_max, frame of the lidar [m]; None if there are none."""

class Recording:
    """A sequence of scans, each of which is read when it is indexed; raises Error if it cannot be read."""

    @property
    def sensor(self) -> Sensor:
        """The sensor, inferred from ten of the scans."""

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Number of each scan in the recording, (N,) int64."""

    @property
    def times(self) -> NDArray[np.float64]:
        """Time of each scan, since the start of the recording or since 1970, (N,) [s]."""

    @property
    def poses(self) -> Optional[NDArray[np.float64]]:
        """Given poses of the lidar, in the frame of the first one, (N, 4, 4); None if there are none."""

    def poses_in(self, map: Map) -> NDArray[np.float64]:
        """Returns the given poses in the frame of a map that was built in the same world, (N, 4, 4).

        Raises Error if there are no poses.
        """

    def __len__(self) -> int:
        """Number of scans."""

    def __getitem__(self, index: int) -> Scan:
        """Reads a scan; negative indices count from the end. Raises IndexError beyond the last one, Error if it cannot be read."""

    def __iter__(self) -> Iterator[Scan]:
        """Reads the scans one after the other."""

class Map:
    """A triangle mesh with its ground and the path of its mapping drive; immutable."""

    @staticmethod
    def load(
        path: _Path, *, backend: _Backend = "auto", cache: Union[bool, _Path, None] = None
    ) -> Map:
        """Reads a map, or a mesh from elsewhere (PLY, OBJ, STL).

        ``backend``: what renders it. ``cache``: where tiles of the map are kept, so that only what is around the car is in
        memory: True for next to the map, or a folder; None: all of the map is in memory, and nothing is written.

        Raises Error if the file cannot be read, is no mesh with ground, or if the folder of ``cache`` cannot be written.
        """

    def save(self, path: _Path) -> None:
        """Writes the map as a PLY file, which is complete by itself; an existing file is replaced.

        Raises Error if the file cannot be written.
        """

    @staticmethod
    def build(
        scans: _Scans,
        poses: Optional[ArrayLike] = None,
        *,
        onto: Optional[Map] = None,
        sensor: Optional[Sensor] = None,
        backend: _Backend = "auto",
        **settings: Any,
    ) -> Map:
        """Builds a map.

        ``scans``: a Recording, or an iterable of Scans and of arrays (N, 3) [m], which are taken as deskewed. ``poses``:
        (N, 4, 4), one per scan, into the frame of the map; by default those of the recording, and without these found from the
        scans. Scans with times are deskewed by them. ``onto``: a map of the same place to which the scans are added: they are
        found in it, what their beams pass through is removed, and what it does not have is added. ``sensor``: by default
        inferred from the scans. Settings: fields of ``map`` in ``fpmcl config build-map --full``.

        Raises Error if poses and scans, or scans and sensor, do not fit each other, or if the scans are not found in ``onto``.
        """

    @property
    def vertices(self) -> NDArray[np.float32]:
        """Vertices in the frame of the map, (V, 3) float32 [m]; read-only, not a copy."""

    @property
    def triangles(self) -> NDArray[np.uint32]:
        """Indices of the vertices of each triangle, (T, 3) uint32; read-only, not a copy."""

    @property
    def colors(self) -> NDArray[np.uint8]:
        """Colours of the vertices, red, green, blue, (V, 3) uint8; red is ground. Read-only, not a copy."""

    @property
    def path(self) -> NDArray[np.float64]:
        """Poses of the mapping drive in the frame of the map, (K, 4, 4)."""

    @property
    def world_from_map(self) -> NDArray[np.float64]:
        """Pose of the map in the world of the poses that it was built with, (4, 4)."""

    @property
    def georeference(self) -> dict[str, float] | None:
        """Place of the map on the Earth: ``latitude_deg``, ``longitude_deg``, ``height_m`` of its origin, ``roll_deg``,
        ``pitch_deg``, ``yaw_deg`` of the rotation to east, north and up, ``epsg`` of its zone of UTM, and the standard
        deviations ``horizontal_m``, ``vertical_m``, ``heading_deg``; None where it is not known."""

    def geodetic(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Latitude, longitude [deg] and height [m] of points of the map, (N, 3) both.

        Raises Error where the place of the map on the Earth is not known.
        """

    @property
    def renderer(self) -> str:
        """What renders the map: backend and device."""

class Localizer:
    """Estimates the pose of a car in a map from its scans. The same seed gives the same estimates.

    ``start``: ``"anywhere"`` (the default in maps of up to 1 km²), ``"road"`` (anywhere along the mapping drive), or a pose
    nearby: (3,), x, y [m] and heading [rad], or (4, 4). ``sensor``: by default inferred from the first scan, own car and times of
    points from the first that show motion; better that of a Recording. ``real_time``: no scan waits until these are inferred,
    which takes seconds; from which scan on they are used depends on the machine. Settings: fields of ``tracker`` in ``fpmcl
    config localize --full``, and ``odometry=None`` for constant velocity where no motion is given.
    """

    def __new__(
        cls,
        map: Map,
        start: Union[Literal["anywhere", "road"], ArrayLike, None] = None,
        *,
        sensor: Optional[Sensor] = None,
        real_time: bool = False,
        **settings: Any,
    ) -> Localizer: ...
    def step(
        self,
        points: Union[Scan, ArrayLike],
        motion: Optional[ArrayLike] = None,
        times: Optional[ArrayLike] = None,
        *,
        time: Optional[float] = None,
    ) -> Estimate:
        """Estimates the pose of the next scan.

        ``points``: a Scan, or (N, 3) in the frame of the lidar [m]. ``motion``: since the previous scan,
        ``p_previous = motion @ p``, (4, 4), or (3,), x, y [m] and heading [rad]; by default from the scans themselves, until one is
        given. ``times``: (N,), when each point was measured, after ``time`` [s]. ``time``: the moment of the pose [s].

        Raises Error if the start is not in the map, the scan is not of the sensor, or the motion is impossible.
        """

class Estimate:
    """Pose of a scan with its uncertainty."""

    @property
    def pose(self) -> NDArray[np.float64]:
        """Pose seen from above: x, y [m], heading [rad], (3,)."""

    @property
    def map_from_lidar(self) -> NDArray[np.float64]:
        """Pose in space, ``p_map = map_from_lidar @ p_lidar``, aligned to the ground of the map, (4, 4)."""

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance of x, y, heading in the axes of the map, (3, 3) [m², m rad, rad²]."""

    @property
    def standard_deviations(self) -> NDArray[np.float64]:
        """Standard deviations of x, y [m], heading [rad], (3,)."""

    @property
    def state(self) -> _State:
        """State of the search; if it is ``"lost"``, the pose must not be used."""

    @property
    def agreement(self) -> Optional[float]:
        """Share of beams above the road that agree with the map, 0 to 1; None where unknown."""

    @property
    def places(self) -> int:
        """Number of places where the car may be: 1 while the search does not compare several."""

    @property
    def mean_cost_m(self) -> Optional[float]:
        """Mean cost at the estimate while tracking, else of the particles [m]; None where the scan was not used."""

    @property
    def effective_sample_size(self) -> float:
        """Effective number of particles after the update, before resampling."""

    @property
    def distortion(self) -> Optional[str]:
        """What is wrong with the points of all scans, where they fit the map only without it; else None."""

    @property
    def updated(self) -> bool:
        """Whether the scan was used; it is not while the car moved too little."""

    @property
    def on_mapped_ground(self) -> bool:
        """Whether there is mapped ground under the estimate."""

    @property
    def previous_from_current(self) -> Optional[NDArray[np.float64]]:
        """The motion since the previous scan that was used, ``p_previous = previous_from_current @ p``, (4, 4); None if
        it is not known.
        """

    @property
    def particles(self) -> NDArray[np.float64]:
        """Particles: x, y [m], heading [rad], weight, (M, 4)."""

class Trajectory:
    """Poses of a drive in the frame of its first scan."""

    @property
    def poses(self) -> NDArray[np.float64]:
        """Pose of each scan, with loops closed and all adjusted, (N, 4, 4)."""

    @property
    def odometry(self) -> NDArray[np.float64]:
        """Poses of the odometry alone, (N, 4, 4)."""

    @property
    def motions(self) -> NDArray[np.float64]:
        """Motion into each scan of the odometry alone, ``p_previous = motion @ p``, (N, 4, 4)."""

class RefinedTrajectory:
    """Refined poses of a drive in a map."""

    @property
    def poses(self) -> NDArray[np.float64]:
        """Poses seen from above: x, y [m], heading [rad], (N, 3)."""

    @property
    def map_from_lidar(self) -> NDArray[np.float64]:
        """Pose of each scan in space, ``p_map = map_from_lidar @ p_lidar``, (N, 4, 4)."""

    @property
    def covariances(self) -> NDArray[np.float64]:
        """Covariances of x, y, heading in the axes of the map, (N, 3, 3) [m², m rad, rad²]."""

    @property
    def states(self) -> list[_State]:
        """State of each scan; ``"searching"`` where its place was not found."""

def read_recording(
    path: _Path,
    poses: Optional[_Path] = None,
    *,
    layout: Optional[str] = None,
    topic: Optional[str] = None,
    calib_file: Optional[_Path] = None,
    body_from_lidar: Optional[ArrayLike] = None,
    start_idx: int = 0,
    n_scans: int = -1,
    frame_step: int = 1,
    motion_compensation: Optional[str] = "auto",
    elevation_bias_deg: float = 0.0,
    imu: Optional[_Path] = None,
    lidar_from_imu: Optional[ArrayLike] = None,
) -> Recording:
    """Opens a recording: a folder of scans (.bin, .pcd, .ply, .npy), a data set such as KITTI, MulRan or nuScenes, or a bag (MCAP, rosbag2,
    ROS 1).

    ``poses``: file of its poses (KITTI, TUM, a folder ``oxts``) or topic of its bag; by default those that the recording
    contains, if there are any. ``calib_file``: calibration of the camera whose poses these are. ``body_from_lidar``: x, y, z
    [m], roll, pitch, yaw [deg] of the lidar on the body whose poses these are. ``layout``: name of the layout, such as
    ``"mulran"``; by default as the files show. ``topic``: of the point clouds in a bag with several, or name of a lidar or scene in a
    folder with several. ``start_idx``, ``n_scans`` (-1: all), ``frame_step``: the frames that are used. ``motion_compensation``:
    ``"auto"``, a rotation such as ``"clockwise"``, or None for compensated scans. ``elevation_bias_deg``: angle to add to the
    elevations of all points [deg]. ``imu``: inertial measurements, a table, a folder ``oxts`` or a topic of the bag, by whose rates
    scans are compensated and rotations predicted; ``lidar_from_imu``: roll, pitch, yaw [deg] of its axes, if they are known.

    Raises Error if something cannot be read, with the file, and what to do.
    """

def infer_sensor(scans: _Scans) -> Sensor:
    """Infers what the sensor is from about ten of some scans, better spread over seconds than neighbours.

    Raises Error if a scan cannot be read.
    """

def odometry(scans: _Scans, **settings: Any) -> Trajectory:
    """Finds the poses of scans from the scans themselves.

    ``scans``: a Recording, or an iterable of Scans and of arrays (N, 3) [m]. Settings: fields of
    ``trajectory`` in ``fpmcl config odometry --full``, such as ``loops=False``.

    Raises Error if a scan cannot be read, or times do not ascend.
    """

def refine(
    map: Map,
    scans: _Scans,
    estimates: Union[Iterable[Estimate], ArrayLike],
    motions: Optional[ArrayLike] = None,
    *,
    sensor: Optional[Sensor] = None,
    uncertainty: ArrayLike = (1.0, 10.0),
    seed: int = 0,
    **settings: Any,
) -> RefinedTrajectory:
    """Refines a trajectory in a map, scan by scan, and smooths it with the motions.

    ``scans``: as of ``Map.build``. ``estimates``: those of a Localizer, or the poses of a rough trajectory, (N, 4, 4) or
    (N, 3), with the standard deviations ``uncertainty=[m, deg]``. ``motions``: into each scan, (N, 4, 4) or (N, 3); without,
    each scan by itself. Settings: fields of ``refiner`` in ``fpmcl config refine --full``.

    Raises Error if there are not as many estimates or motions as scans, or if a scan cannot be read.
    """

def write_trajectory(path: _Path, poses: ArrayLike, times: ArrayLike) -> None:
    """Writes poses as rows ``time x y z qx qy qz qw`` [s, m] (TUM), which evo and ``fpmcl evaluate`` read.

    ``poses``: (N, 4, 4). ``times``: (N,) [s]. An existing file is replaced.

    Raises Error if the file cannot be written, or there is not one time per pose.
    """

def evaluate(
    estimates: ArrayLike, truth: ArrayLike, *, skip: int = 0
) -> dict[str, dict[str, float]]:
    """Errors of estimates against true poses: a dict of dicts with ``rmse``, ``mean``, ``median``, ``p95`` and ``max``.

    ``estimates``, ``truth``: (N, 4, 4) in the same frame. ``skip``: number of first poses that are left out.
    ``position_m``: distance to the true position. ``height_m``: magnitude of the height error. ``rotation_rad``: angle of the
    rotation. ``aligned_position_m``, ``aligned_rotation_rad``: the same after rigid alignment; missing on a straight line.

    Raises Error if there are not as many estimates as true poses, or none is left.
    """

def cast_rays(map: Map, poses: ArrayLike, directions: ArrayLike) -> NDArray[np.float32]:
    """Casts rays at a map: ranges along directions from the origin of the lidar, infinite without a hit [m].

    ``poses``: (4, 4) or (P, 4, 4). ``directions``: (N, 3), unit vectors in the frame of the lidar. Returns (N,) float32, or
    (P, N). Raises ValueError if a direction is no unit vector, Error if the map cannot be rendered.
    """

def classify_ground(points: ArrayLike, **settings: Any) -> NDArray[np.float32]:
    """Returns the confidence that each point of a scan is ground, (N,) float32, 0 to 1.

    ``points``: (N, 3), one revolution in the frame of the lidar [m]. Settings: ``method`` (``"fuzzy"``, ``"pca"``,
    ``"ransac"``) and the other fields of ``ground`` in ``fpmcl config ground --full``. Raises Error if a setting is out of its range.
    """

def main() -> int:
    """Runs the program with the arguments of the process; returns its exit code."""
