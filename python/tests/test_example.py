"""The examples run, and find the car."""

import os
import py_compile
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parent.parent / "examples/scene.py"
DATA = Path(os.environ.get("FPMCL_DATA", Path(__file__).parents[3] / "shared/data"))


def run(*arguments):
    command = [sys.executable, EXAMPLE, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_without_data_the_example_says_so(tmp_path):
    assert run(tmp_path / "none") == f"skipped: {tmp_path / 'none'} does not exist\n"


def test_the_node_of_ros_2_is_python(tmp_path):
    # Without ROS it cannot run.
    py_compile.compile(str(EXAMPLE.with_name("ros2_node.py")), doraise=True, cfile=str(tmp_path / "node.pyc"))


def test_the_scene_is_localized_to_centimetres(tmp_path):
    pytest.importorskip("matplotlib")
    folder = DATA / "nuscenes-hdl32"
    if not folder.is_dir():
        pytest.skip(f"{folder} does not exist")
    text = run(folder, tmp_path / "scene.png")
    rows = re.findall(r"(\w+): (\d+) of 16 scans, RMSE ([\d.]+) cm", text)
    assert [row[0] for row in rows] == ["localized", "refined"]
    for _name, found, rmse_cm in rows:
        assert int(found) >= 14 and float(rmse_cm) < 4.0, text
    assert (tmp_path / "scene.png").stat().st_size > 10_000
