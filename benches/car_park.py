"""A covered car park of two equal storeys, joined by a ramp, as two recordings with poses.

    python benches/car_park.py FOLDER       # writes FOLDER/drive_1 and FOLDER/drive_2 in the layout of KITTI

The car drives once around on the lower storey, up the ramp, and around on the upper one. Pillars, walls and ceilings of
both storeys are the same, the parked cars are random, and others in each drive. The sensor has 32 beams from -25 to +15
degrees, 720 measurements each, a noise of 2 cm, and scans every 0.6 m without motion during a revolution.
"""

import sys
from pathlib import Path

import numpy as np

LENGTH_M, WIDTH_M, STOREY_M, SLAB_M = 64.0, 34.0, 3.0, 0.3
# Lower and upper corner of the ramp, and of the opening above it.
RAMP_M = np.array([[18.0, 15.0], [42.0, 19.0]])
OPENING_M = np.array([[22.0, 15.0], [42.0, 19.0]])
SENSOR_M = 1.8


def boxes(drive):
    """Corners of all boxes: walls, slabs with the opening, pillars, parked cars; shape (n, 2, 3) [m]."""
    found = []

    def box(x0, y0, z0, x1, y1, z1):
        found.append([[x0, y0, z0], [x1, y1, z1]])

    box(0, 0, -SLAB_M, LENGTH_M, WIDTH_M, 0)
    box(0, 0, 2 * STOREY_M - SLAB_M, LENGTH_M, WIDTH_M, 2 * STOREY_M)
    (x0, y0), (x1, y1) = OPENING_M
    below, above = STOREY_M - SLAB_M, STOREY_M
    box(0, 0, below, LENGTH_M, y0, above)
    box(0, y1, below, LENGTH_M, WIDTH_M, above)
    box(0, y0, below, x0, y1, above)
    box(x1, y0, below, LENGTH_M, y1, above)
    top = 2 * STOREY_M
    box(-0.3, 0, 0, 0, WIDTH_M, top)
    box(LENGTH_M, 0, 0, LENGTH_M + 0.3, WIDTH_M, top)
    box(0, -0.3, 0, LENGTH_M, 0, top)
    box(0, WIDTH_M, 0, LENGTH_M, WIDTH_M + 0.3, top)
    for x in np.arange(8.0, LENGTH_M, 8.0):
        for y in (5.0, 12.0, 22.0, 29.0):
            box(x - 0.2, y - 0.2, 0, x + 0.2, y + 0.2, top)
    rng = np.random.default_rng(drive)
    for floor in (0.0, STOREY_M):
        for x in np.arange(2.0, LENGTH_M - 2, 8.0 / 3):
            for y in (2.5, WIDTH_M - 2.5):
                if rng.random() < 0.5:
                    length, width, height = rng.uniform([3.8, 1.65, 1.4], [4.8, 1.9, 1.8])
                    box(x - width / 2, y - length / 2, floor + 0.2, x + width / 2, y + length / 2, floor + height)
    return np.array(found)


def path():
    """Positions on the floor every 0.6 m, shape (n, 3) [m], and the heading and pitch of the car there, shape (n,) [rad]."""
    corners = [(6, 8.5), (58, 8.5), (58, 25.5), (6, 25.5), (6, 17), (58, 17), (58, 25.5), (6, 25.5), (6, 8.5), (50, 8.5)]
    corners = np.array(corners, float)
    dense = np.concatenate([np.linspace(a, b, 200, endpoint=False) for a, b in zip(corners, corners[1:])])
    # Rounds the corners: the mean of 4 m of path.
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    stations = np.arange(0, at[-1], 0.1)
    fine = np.stack([np.interp(stations, at, dense[:, axis]) for axis in (0, 1)], axis=1)
    fine = np.stack([np.convolve(fine[:, axis], np.ones(41) / 41, "valid") for axis in (0, 1)], axis=1)
    # The straight line along y = 17 leads up the ramp; what follows is on the upper storey.
    ramp = np.clip((fine[:, 0] - RAMP_M[0, 0]) / (RAMP_M[1, 0] - RAMP_M[0, 0]), 0, 1) * STOREY_M
    is_on_line = (np.abs(fine[:, 1] - 17) < 1e-6) & (np.gradient(fine[:, 0]) > 0.05)
    begin, end = np.flatnonzero(is_on_line)[[0, -1]]
    index = np.arange(len(fine))
    height = np.where(index < begin, 0, np.where(index > end, STOREY_M, ramp))
    points = np.column_stack([fine, height])[::6]
    step = np.gradient(points, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    pitch = -np.arctan2(step[:, 2], np.linalg.norm(step[:, :2], axis=1))
    return points, heading, pitch


def rotation(heading, pitch):
    """Rotation from the frame of the car to that of the building; a negative pitch lifts the front [rad]."""
    c, s = np.cos(heading), np.sin(heading)
    yaw = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = np.cos(pitch), np.sin(pitch)
    return yaw @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def ranges(origin, directions, solids):
    """Distances to the nearest box or the ramp; infinite where there is none [m]."""
    with np.errstate(divide="ignore"):
        inverse = 1 / directions
    nearest = np.full(len(directions), np.inf)
    for low, high in solids:
        to_low, to_high = (low - origin) * inverse, (high - origin) * inverse
        enter = np.minimum(to_low, to_high).max(axis=1)
        leave = np.maximum(to_low, to_high).min(axis=1)
        nearest = np.where((enter < leave) & (enter > 0), np.minimum(nearest, enter), nearest)
    slope = STOREY_M / (RAMP_M[1, 0] - RAMP_M[0, 0])
    normal = np.array([-slope, 0, 1.0])
    start = np.array([RAMP_M[0, 0], 0, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = ((start - origin) @ normal) / (directions @ normal)
    point = origin + hit[:, None] * directions
    is_on = ((point[:, :2] > RAMP_M[0]) & (point[:, :2] < RAMP_M[1])).all(axis=1) & (hit > 0)
    return np.where(is_on, np.minimum(nearest, hit), nearest)


def main(folder):
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(15, -25, 32)), np.linspace(np.pi, -np.pi, 720, endpoint=False), indexing="ij"
    )
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    points, heading, pitch = path()
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    for pose, point, yaw, nose in zip(poses, points, heading, pitch):
        pose[:3, :3] = rotation(yaw, nose)
        pose[:3, 3] = point + pose[:3, :3] @ [0, 0, SENSOR_M]
    relative = np.linalg.inv(poses[0]) @ poses
    for drive in (1, 2):
        out = Path(folder) / f"drive_{drive}"
        (out / "velodyne").mkdir(parents=True, exist_ok=True)
        np.savetxt(out / "poses.txt", relative[:, :3].reshape(-1, 12))
        (out / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
        np.savetxt(out / "times.txt", 0.1 * np.arange(len(poses)))
        solids, rng = boxes(drive), np.random.default_rng(100 + drive)
        for number, pose in enumerate(poses):
            range_m = ranges(pose[:3, 3], rays @ pose[:3, :3].T, solids) + rng.normal(0, 0.02, len(rays))
            scan = np.where(np.isfinite(range_m)[:, None], rays * range_m[:, None], np.nan)
            scan = np.column_stack([scan, np.full(len(rays), 0.5)])[np.isfinite(range_m)]
            scan.astype("<f4").tofile(out / "velodyne" / f"{number:06}.bin")


if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        sys.exit(__doc__)
    main(sys.argv[1])
