"""The package on arrays: shapes, memory, errors, the interpreter lock."""

import ast
import inspect
import logging
import threading
import time
from pathlib import Path

import fpmcl
import numpy as np
import pytest

HALF_M = 30.0
SQUARE = f"""\
v {-HALF_M} {-HALF_M} 0
v {HALF_M} {-HALF_M} 0
v {HALF_M} {HALF_M} 0
v {-HALF_M} {HALF_M} 0
f 1 2 3
f 1 3 4
"""


@pytest.fixture(scope="module")
def square(tmp_path_factory):
    """A map that is a square of flat ground at height 0."""
    path = tmp_path_factory.mktemp("map") / "square.obj"
    path.write_text(SQUARE)
    return fpmcl.Map.load(path, backend="cpu")


@pytest.fixture(scope="module")
def recording(folder):
    return fpmcl.read_recording(folder / "drive_1")


@pytest.fixture(scope="module")
def world(folder):
    return fpmcl.Map.load(folder / "map.ply", backend="cpu")


def pose(x=0.0, y=0.0, z=0.0, heading=0.0):
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    matrix[:3, 3] = x, y, z
    return matrix


def test_rays_hit_the_ground_where_geometry_says(square):
    angles = np.radians([90.0, 45.0, 30.0, -10.0])
    directions = np.stack([np.cos(angles), 0 * angles, -np.sin(angles)], axis=1).astype(np.float32)
    ranges = fpmcl.cast_rays(square, pose(z=2.0), directions)
    assert ranges.dtype == np.float32 and ranges.shape == (4,)
    np.testing.assert_allclose(ranges[:3], 2.0 / np.sin(angles[:3]), rtol=1e-5)
    assert ranges[3] == np.inf
    both = fpmcl.cast_rays(square, [pose(z=2.0), pose(x=1.0, z=4.0, heading=1.0)], directions)
    np.testing.assert_array_equal(both[0], ranges)
    np.testing.assert_allclose(both[1, :3], 4.0 / np.sin(angles[:3]), rtol=1e-5)


def test_directions_of_other_layouts_give_the_same_ranges(square):
    wide = np.zeros((50, 6))
    wide[:, 2] = -1.0
    expected = fpmcl.cast_rays(square, pose(z=3.0), np.float32(wide[:, :3]))
    np.testing.assert_array_equal(expected, np.full(50, 3.0, np.float32))
    for directions in (wide[:, :3], np.asfortranarray(wide[:, :3]), wide[:, :3].tolist()):
        np.testing.assert_array_equal(fpmcl.cast_rays(square, pose(z=3.0), directions), expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.eye(4), np.ones((5, 4))), r"directions has the shape \(5, 4\); it must be \(N, 3\)"),
        ((np.eye(4), np.ones((5, 3))), "direction 0 .* no unit vector"),
        ((np.eye(4), np.full((5, 3), np.nan)), "direction 0 .* no unit vector"),
        ((np.eye(3), np.ones((5, 3))), r"poses has the shape \(3, 3\)"),
        ((2 * np.eye(4), np.ones((5, 3))), "poses is no rigid transform"),
        ((np.diag([1.0, 1.0, -1.0, 1.0]), np.ones((5, 3))), "poses is no rigid transform"),
    ],
)
def test_a_wrong_array_is_an_error_that_names_it(square, arguments, message):
    with pytest.raises(ValueError, match=message):
        fpmcl.cast_rays(square, *arguments)


def test_ground_is_recognized(recording):
    points = recording[0].points
    confidence = fpmcl.classify_ground(points)
    assert confidence.shape == (len(points),) and confidence.dtype == np.float32
    near = np.hypot(points[:, 0], points[:, 1]) < 15.0
    is_low, is_high = near & (points[:, 2] < -1.6), near & (points[:, 2] > -0.5)
    assert confidence[is_low].mean() > 0.8 and confidence[is_high].mean() < 0.2
    strided = np.zeros((len(points), 4), np.float32)
    strided[:, :3] = points
    np.testing.assert_array_equal(fpmcl.classify_ground(strided[:, :3]), confidence)
    pca = fpmcl.classify_ground(points, ground_method="pca")
    assert not np.array_equal(pca, confidence)


def test_a_recording_is_a_sequence_of_scans(folder, recording):
    assert len(recording) == 12 and len(list(recording)) == 12
    assert recording[-1].number == 11
    with pytest.raises(IndexError):
        recording[12]
    odd = fpmcl.read_recording(folder / "drive_1", start_idx=1, frame_step=2, n_scans=6)
    np.testing.assert_array_equal(odd.numbers, [1, 3, 5])
    np.testing.assert_array_equal(odd[1].points, recording[3].points)
    assert recording.poses.shape == (12, 4, 4)
    np.testing.assert_array_equal(recording[4].pose, recording.poses[4])
    assert recording.sensor.beams == 32
    assert recording.sensor.height == pytest.approx(1.73, abs=0.05)


def test_views_share_memory_and_outlive_their_owner(folder):
    scan = fpmcl.read_recording(folder / "drive_1", n_scans=2)[0]
    points = scan.points
    assert np.shares_memory(points, scan.points) and not points.flags.writeable
    with pytest.raises(ValueError):
        points[0, 0] = 1.0
    copy = points.copy()
    del scan
    np.testing.assert_array_equal(points, copy)
    loaded = fpmcl.Map.load(folder / "map.ply")
    assert np.shares_memory(loaded.vertices, loaded.vertices)
    assert loaded.triangles.max() < len(loaded.vertices) == len(loaded.colors)


def test_a_scan_keeps_what_it_is_given():
    points = np.arange(12.0).reshape(4, 3)
    scan = fpmcl.Scan(points, [0.0, 0.1, 0.2, 0.3], time=7.0, rings=[3, 2, 1, 0])
    np.testing.assert_array_equal(scan.points, points.astype(np.float32))
    np.testing.assert_array_equal(scan.times, np.float32([0.0, 0.1, 0.2, 0.3]))
    np.testing.assert_array_equal(scan.rings, [3, 2, 1, 0])
    assert scan.time == 7.0 and scan.intensities is None and len(scan) == 4
    with pytest.raises(ValueError, match="times has 3 values for 4 points"):
        fpmcl.Scan(points, [0.0, 0.1, 0.2])


def test_odometry_follows_the_drive(recording):
    arrays = [scan.points for scan in recording]
    found = fpmcl.odometry(arrays)
    truth = np.linalg.inv(recording.poses[0]) @ recording.poses
    assert found.poses.shape == (12, 4, 4)
    errors = np.linalg.norm(found.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert errors.max() < 0.15
    chained = found.odometry[4] @ found.motions[5]
    np.testing.assert_allclose(chained, found.odometry[5], atol=1e-9)


def test_a_map_of_arrays_and_poses_is_that_of_the_recording(recording):
    of_recording = fpmcl.Map.build(recording, depth=7)
    arrays = (scan.points for scan in recording)
    of_arrays = fpmcl.Map.build(arrays, recording.poses, sensor=recording.sensor, depth=7)
    assert abs(len(of_arrays.vertices) / len(of_recording.vertices) - 1.0) < 0.01


def test_a_given_start_and_a_given_motion_are_used(folder, recording):
    loaded = fpmcl.Map.load(folder / "map.ply", backend="cpu")
    truth = recording.poses_in(loaded)
    settings = {"sensor": recording.sensor, "numParticles": 500}
    localizer = fpmcl.Localizer(loaded, truth[0], **settings)
    motion = np.linalg.inv(truth[0]) @ truth[1]
    localizer.step(recording[0], np.eye(4))
    estimate = localizer.step(recording[1], motion)
    np.testing.assert_allclose(estimate.previous_from_current, motion, atol=1e-9)
    assert np.linalg.norm(estimate.map_from_lidar[:3, 3] - truth[1, :3, 3]) < 0.2
    assert np.linalg.norm(estimate.particles[:, 3].sum() - 1.0) < 1e-9
    far = fpmcl.Localizer(loaded, [5000.0, 0.0, 0.0], **settings)
    with pytest.raises(fpmcl.Error, match="outside the mapped area"):
        far.step(recording[0])
    with pytest.raises(ValueError, match='start is "nowhere"'):
        fpmcl.Localizer(loaded, "nowhere")


def test_in_real_time_the_first_scans_have_the_same_estimates(folder, recording):
    loaded = fpmcl.Map.load(folder / "map.ply", backend="cpu")
    start = recording.poses_in(loaded)[0]
    waiting, real_time = (
        fpmcl.Localizer(loaded, start, real_time=real_time, numParticles=500) for real_time in (False, True)
    )
    for index in range(3):
        expected, found = (localizer.step(recording[index]) for localizer in (waiting, real_time))
        np.testing.assert_array_equal(found.map_from_lidar, expected.map_from_lidar)


def test_rough_poses_are_refined(folder, recording):
    loaded = fpmcl.Map.load(folder / "map.ply", backend="cpu")
    truth = recording.poses_in(loaded)
    rough = truth.copy()
    rough[:, :2, 3] += [0.3, -0.3]
    refined = fpmcl.refine(loaded, recording, rough, uncertainty=[0.5, 2])
    errors = np.linalg.norm(refined.map_from_lidar[:, :2, 3] - truth[:, :2, 3], axis=1)
    assert np.median(errors) < 0.05
    with pytest.raises(fpmcl.Error, match="there are 3 estimates for 12 scans"):
        fpmcl.refine(loaded, recording, rough[:3])


def test_wrong_settings_are_errors_that_name_them(square):
    with pytest.raises(fpmcl.Error, match="unknown key `numParticle`.*num_particles"):
        fpmcl.Localizer(square, numParticle=5)
    with pytest.raises(fpmcl.Error, match="numParticles") as error:
        fpmcl.Localizer(square, numParticles=0)
    # In the words of Python, not of the command line.
    assert "--" not in str(error.value)
    for call in [fpmcl.Localizer, lambda map: fpmcl.refine(map, [], [])]:
        with pytest.raises(TypeError, match="is a .*str.*, not a fpmcl.Map; fpmcl.Map.load"):
            call("map.ply")
    with pytest.raises(fpmcl.Error, match="unknown key `result_path`"):
        fpmcl.Localizer(square, result_path="a.npz")
    fpmcl.Localizer(square, observation={"beams": np.int64(500)}, **{"kld.bin_m": 0.5})
    fpmcl.Localizer(square, convergence={"max_spread_m": float("inf")}, odometry=None)


def test_a_map_needs_no_poses(recording):
    arrays = [scan.points for scan in recording]
    found = fpmcl.Map.build(arrays, depth=7)
    given = fpmcl.Map.build(recording, depth=7)
    assert abs(len(found.vertices) / len(given.vertices) - 1.0) < 0.1
    assert found.path.shape == given.path.shape
    with pytest.raises(fpmcl.Error, match="1 poses for 2 scans"):
        fpmcl.Map.build([recording[0], recording[1]], np.eye(4))


def test_a_map_without_gnss_has_no_place_on_the_earth(world):
    assert world.georeference is None
    with pytest.raises(fpmcl.Error, match="place of the map"):
        world.geodetic(np.zeros((1, 3)))


def test_a_second_drive_is_added_to_a_map(recording, world):
    extended = fpmcl.Map.build(recording, onto=world, depth=8)
    assert len(extended.vertices) > 0
    np.testing.assert_allclose(extended.world_from_map, world.world_from_map)
    with pytest.raises(ValueError, match="leave out poses"):
        fpmcl.Map.build(recording, recording.poses, onto=world)
    with pytest.raises(TypeError, match=r"fpmcl\.Map\.load"):
        fpmcl.Map.build(recording, onto="map.ply")


def test_errors_are_those_of_geometry():
    truth = np.tile(np.eye(4), (5, 1, 1))
    truth[:, 0, 3] = np.arange(5.0)
    truth[2:, 1, 3] = 3.0
    estimates = truth.copy()
    estimates[:, :3, 3] += [0.3, 0.4, 0.0]
    errors = fpmcl.evaluate(estimates, truth)
    assert errors["position_m"]["rmse"] == pytest.approx(0.5)
    assert errors["height_m"]["max"] == 0.0
    assert errors["aligned_position_m"]["max"] == pytest.approx(0.0, abs=1e-9)
    estimates[0, 0, 3] += 100.0
    assert fpmcl.evaluate(estimates, truth, skip=1)["position_m"]["max"] == pytest.approx(0.5)
    with pytest.raises(fpmcl.Error, match="4 estimates and 5 true poses"):
        fpmcl.evaluate(estimates[:4], truth)


def test_a_trajectory_is_written_for_other_programs(tmp_path, recording):
    path = tmp_path / "poses.tum"
    fpmcl.write_trajectory(path, recording.poses, recording.times)
    rows = np.loadtxt(path)
    np.testing.assert_allclose(rows[:, 0], recording.times, atol=1e-6)
    np.testing.assert_allclose(rows[:, 1:4], recording.poses[:, :3, 3], atol=1e-6)
    with pytest.raises(fpmcl.Error, match="one per pose"):
        fpmcl.write_trajectory(path, recording.poses, recording.times[1:])


def test_objects_say_what_they_are(recording, world):
    assert repr(recording[3]).startswith("<fpmcl.Scan 3: ")
    assert "triangles" in repr(world) and "12 scans" in repr(recording)
    assert repr(fpmcl.odometry(recording)) == "<fpmcl.Trajectory: 12 poses>"
    assert "beams" in repr(recording.sensor)


def test_other_threads_run_meanwhile(recording):
    scans = [recording[0], recording[1], recording[2]]
    done = threading.Event()
    ticks = 0

    def build():
        fpmcl.Map.build(scans, recording.poses[:3], depth=7)
        done.set()

    thread = threading.Thread(target=build)
    thread.start()
    while not done.is_set():
        time.sleep(0.001)
        ticks += 1
    thread.join()
    assert ticks > 20


def test_warnings_of_the_library_are_logged(folder, tmp_path, caplog):
    drive = folder / "drive_1"
    (tmp_path / "velodyne").symlink_to(drive / "velodyne")
    (tmp_path / "calib.txt").write_text((drive / "calib.txt").read_text())
    rows = (drive / "poses.txt").read_text().splitlines(keepends=True)
    (tmp_path / "poses.txt").write_text("".join(rows[:-1]))
    with caplog.at_level(logging.WARNING, logger="fpmcl"):
        recording = fpmcl.read_recording(tmp_path)
    assert len(recording) == 11
    assert "has no pose for these frames: 11" in caplog.text


def test_stubs_and_docstrings_are_those_of_the_module():
    stubs = ast.parse(Path(fpmcl.__file__).with_name("__init__.pyi").read_text())
    stubbed = {node.name: node for node in stubs.body if hasattr(node, "name")}
    exported = {name for name in fpmcl.__all__ if not name.startswith("_")}
    assert set(stubbed) == exported
    for name, node in stubbed.items():
        member = getattr(fpmcl, name)
        assert inspect.getdoc(member), name
        members = {it.name for it in getattr(node, "body", []) if hasattr(it, "name")}
        members = {it for it in members if not it.startswith("__")}
        own = {it for it in vars(member) if not it.startswith("_")} if members else set()
        assert members == own, name
        assert all(inspect.getdoc(getattr(member, it)) for it in members), name


def test_the_package_is_typed():
    assert Path(fpmcl.__file__).with_name("py.typed").exists()
