"""A recording as a data loader of KISS-ICP (Vizzo et al. 2023) reads it, as JSON: read.py LOADER FOLDER [SEQUENCE]."""

import contextlib
import json
import sys
from pathlib import Path

from kiss_icp.datasets import dataset_factory

loader, folder, *sequence = sys.argv[1:]
with contextlib.redirect_stdout(sys.stderr):
    dataset = dataset_factory(loader, Path(folder), sequence=(sequence or [None])[0], topic=None)
    frames = [dataset[index] for index in range(len(dataset))]
    stamps = dataset.get_frames_timestamps() if loader == "rosbag" else None

scans = []
for frame in frames:
    points, times = frame if isinstance(frame, tuple) else (frame, [])
    scans.append({"points": points.tolist(), "times": list(map(float, times))})
poses = dataset.gt_poses.tolist() if hasattr(dataset, "gt_poses") else None
json.dump({"scans": scans, "stamps": stamps, "poses": poses}, sys.stdout)
