"""Writes a drive of `fpmcl simulate` in the layout of KITTI's raw data.

    fpmcl simulate --set n_scans=300
    python benches/kitti_raw.py data/street/drive_1 results/kitti_raw
    fpmcl benchmark kitti_raw results/kitti_raw/2011_09_26/2011_09_26_drive_0001_sync

Scans, their times, `oxts` (position on the Earth, angles, and zeros) at each scan, and the calibration files of the day:
Geiger, Lenz, Stiller, Urtasun, *Vision meets Robotics: The KITTI Dataset* (IJRR 2013), and the readme of its development kit.
"""

import argparse
import datetime
import math
import pathlib
import shutil

EARTH_RADIUS_M = 6378137.0
FIRST_LAT_DEG, FIRST_LON_DEG = 49.0, 8.4
START = datetime.datetime(2011, 9, 26, 13, 2, 25)


def matrix_of(words):
    """Twelve numbers as a matrix of 3 x 4."""
    numbers = [float(word) for word in words]
    return [numbers[0:4], numbers[4:8], numbers[8:12]]


def times(a, b):
    """Product of two transforms."""
    product = [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(4)] for i in range(3)]
    for i in range(3):
        product[i][3] += a[i][3]
    return product


def inverse(a):
    rotation = [[a[j][i] for j in range(3)] for i in range(3)]
    return [
        [*rotation[i], -sum(rotation[i][k] * a[k][3] for k in range(3))] for i in range(3)
    ]


def calibration(transform):
    rotation = " ".join(str(transform[i][j]) for i in range(3) for j in range(3))
    translation = " ".join(str(transform[i][3]) for i in range(3))
    return f"calib_time: 15-Mar-2012 11:37:16\nR: {rotation}\nT: {translation}\n"


def oxts(world_from_imu):
    """A row of 30 numbers; the scale of the Mercator projection is that of the first latitude."""
    scale = math.cos(math.radians(FIRST_LAT_DEG)) * EARTH_RADIUS_M
    r = world_from_imu
    east_m, north_m, up_m = (r[i][3] for i in range(3))
    first_north_m = scale * math.log(math.tan(math.radians(45 + FIRST_LAT_DEG / 2)))
    lat_deg = 2 * math.degrees(math.atan(math.exp((first_north_m + north_m) / scale))) - 90
    lon_deg = FIRST_LON_DEG + math.degrees(east_m / scale)
    roll, yaw = math.atan2(r[2][1], r[2][2]), math.atan2(r[1][0], r[0][0])
    pitch = math.atan2(-r[2][0], math.hypot(r[2][1], r[2][2]))
    numbers = [lat_deg, lon_deg, 110 + up_m, roll, pitch, yaw, *[0] * 24]
    return " ".join(repr(number) for number in numbers) + "\n"


def stamps(count, after_s=0.0):
    moments = (START + datetime.timedelta(seconds=0.1 * row + after_s) for row in range(count))
    return "".join(f"{moment:%Y-%m-%d %H:%M:%S.%f}000\n" for moment in moments)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=pathlib.Path)
    parser.add_argument("folder", type=pathlib.Path)
    arguments = parser.parse_args()
    lines = (arguments.drive / "calib.txt").read_text().splitlines()
    (camera_from_lidar,) = [matrix_of(line.split()[1:]) for line in lines if line.startswith("Tr:")]
    lines = (arguments.drive / "poses.txt").read_text().splitlines()
    world_from_camera = [matrix_of(line.split()) for line in lines]
    lidar_from_imu = [[1, 0, 0, -0.81], [0, 1, 0, 0.32], [0, 0, 1, -0.8]]
    day = arguments.folder / "2011_09_26"
    drive = day / "2011_09_26_drive_0001_sync"
    for name in ["velodyne_points/data", "oxts/data"]:
        (drive / name).mkdir(parents=True)
    for row, pose in enumerate(world_from_camera):
        lidar = times(times(inverse(camera_from_lidar), pose), camera_from_lidar)
        (drive / f"oxts/data/{row:010}.txt").write_text(oxts(times(lidar, lidar_from_imu)))
        scan = arguments.drive / f"velodyne/{row:06}.bin"
        shutil.copyfile(scan, drive / f"velodyne_points/data/{row:010}.bin")
    count = len(world_from_camera)
    for name, after_s in [("", 0.0), ("_start", -0.05), ("_end", 0.05)]:
        path = drive / f"velodyne_points/timestamps{name}.txt"
        path.write_text(stamps(count, after_s))
    (drive / "oxts/timestamps.txt").write_text(stamps(count))
    identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    (day / "calib_imu_to_velo.txt").write_text(calibration(lidar_from_imu))
    (day / "calib_velo_to_cam.txt").write_text(calibration(camera_from_lidar))
    cameras = "".join(
        f"P_rect_0{camera}: 721.5 0 609.6 0 0 721.5 172.9 0 0 0 1 0\n"
        f"R_rect_0{camera}: {' '.join(str(identity[i][j]) for i in range(3) for j in range(3))}\n"
        for camera in range(4)
    )
    (day / "calib_cam_to_cam.txt").write_text(cameras)


if __name__ == "__main__":
    main()
