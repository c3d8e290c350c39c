"""A simulated drive, its map and its localization by the program."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# The program to compare with; by default the one that the package installs.
PROGRAM = os.environ.get("FPMCL_PROGRAM", str(Path(sys.executable).with_name("fpmcl")))


def run(*arguments, cwd=None, program=PROGRAM):
    """Runs the program; returns its standard output."""
    command = [program, *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A drive of 12 scans with the map and the result that the program makes of it."""
    folder = tmp_path_factory.mktemp("drive")
    simulation = ["output_folder=.", "n_scans=12", "scanner.beams=32", "scanner.azimuth_steps=600"]
    run("simulate", *settings(simulation), cwd=folder)
    built = ["depth=8", "visualize=False"]
    run("build-map", "drive_1", "--output", "map.ply", *settings(built), cwd=folder)
    localized = ["numParticles=2000", "refine=True", "plot_loc_results=False"]
    start = ["--output", "run/localization.npz", "--seed", 3, "--backend", "cpu"]
    run("localize", "drive_1", "--map", "map.ply", *start, *settings(localized), cwd=folder)
    return folder


def settings(pairs):
    return [word for pair in pairs for word in ("--set", pair)]
