"""The results of the package are those of the program, byte for byte."""

import subprocess
import sys
from pathlib import Path

import fpmcl
import numpy as np
import pytest
from conftest import run


@pytest.fixture(scope="module")
def recording(folder):
    return fpmcl.read_recording(folder / "drive_1")


@pytest.fixture(scope="module")
def localized(folder, recording):
    fpmcl_map = fpmcl.Map.load(folder / "map.ply", backend="cpu")
    localizer = fpmcl.Localizer(
        fpmcl_map, sensor=recording.sensor, numParticles=2000, seed=3
    )
    return fpmcl_map, [localizer.step(scan) for scan in recording]


@pytest.fixture(scope="module")
def result(folder):
    return np.load(folder / "run/localization.npz")


def test_a_map_is_the_same_file(folder, recording, tmp_path):
    built = fpmcl.Map.build(recording, depth=8)
    built.save(tmp_path / "map.ply")
    assert (tmp_path / "map.ply").read_bytes() == (folder / "map.ply").read_bytes()
    assert len(built.path) > 0
    np.testing.assert_allclose(recording.poses_in(built)[0], np.eye(4), atol=1e-9)


def test_estimates_have_the_same_bytes(localized, result):
    estimates = localized[1]
    poses = np.array([estimate.pose for estimate in estimates])
    assert poses.tobytes() == result["estimates"].tobytes()
    covariances = np.array([estimate.covariance for estimate in estimates])
    assert covariances.tobytes() == result["covariances"].tobytes()
    last = estimates[-1].particles.astype(np.float32)
    assert last.tobytes() == result["particles"][-1, : len(last)].tobytes()
    agreements = [-1.0 if it.agreement is None else it.agreement for it in estimates]
    assert np.array(agreements).tobytes() == result["agreements"].tobytes()


def test_refined_poses_have_the_same_bytes(localized, recording, result):
    fpmcl_map, estimates = localized
    refined = fpmcl.refine(fpmcl_map, recording, estimates, seed=3)
    assert refined.poses.tobytes() == result["refined"].tobytes()
    assert refined.states == [estimate.state for estimate in estimates]


def test_the_car_is_found(localized, recording):
    fpmcl_map, estimates = localized
    assert estimates[-1].state == "tracking"
    errors = [
        estimate.map_from_lidar[:3, 3] - truth[:3, 3]
        for estimate, truth in zip(estimates, recording.poses_in(fpmcl_map))
    ]
    assert np.linalg.norm(errors[-1]) < 0.1
    assert np.all(estimates[-1].standard_deviations < 0.2)


def test_the_package_contains_the_program():
    program = Path(sys.executable).with_name("fpmcl")
    version = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    assert version.stdout == f"fpmcl {fpmcl.__version__}\n"
    failed = subprocess.run([program, "info", "missing"], capture_output=True, text=True, check=False)
    assert failed.returncode == 1 and "missing" in failed.stderr
    wrong = subprocess.run([program, "inof"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2


def test_a_message_is_that_of_the_program(folder):
    missing = folder / "none.ply"
    with pytest.raises(fpmcl.Error) as error:
        fpmcl.Map.load(missing)
    program = Path(sys.executable).with_name("fpmcl")
    failed = subprocess.run([program, "info", missing], capture_output=True, text=True, check=False)
    assert "none.ply" in str(error.value) and "none.ply" in failed.stderr


def test_a_log_is_read_by_the_package_mcap(folder, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    log = tmp_path / "run.mcap"
    run("export", folder / "run/localization.npz", "--mcap", log, cwd=folder)
    with log.open("rb") as file:
        summary = reader.make_reader(file).get_summary()
        counts = {
            summary.channels[channel].topic: count
            for channel, count in summary.statistics.channel_message_counts.items()
        }
    assert counts["/scan"] == counts["/refined"] == 12
    assert counts["/map"] == 1
