"""Maps one scene of nuScenes, localizes its other scans in the map, and plots: python scene.py [FOLDER [PICTURE]]."""

import os
import sys
from pathlib import Path

import fpmcl
import numpy as np

data = os.environ.get("FPMCL_DATA", "../shared/data")
folder = Path(sys.argv[1] if len(sys.argv) > 1 else f"{data}/nuscenes-hdl32")
if not folder.is_dir():
    print(f"skipped: {folder} does not exist")
    sys.exit()
even = fpmcl.read_recording(folder, frame_step=2)
odd = fpmcl.read_recording(folder, frame_step=2, start_idx=1)
scene = fpmcl.Map.build(even)
localizer = fpmcl.Localizer(scene, sensor=odd.sensor)
estimates = [localizer.step(scan) for scan in odd]
refined = fpmcl.refine(scene, odd, estimates)

truth = odd.poses_in(scene)[:, :2, 3]
path = np.array([estimate.pose[:2] for estimate in estimates])
found = np.array([estimate.state == "tracking" for estimate in estimates])
for name, xy in [("localized", path), ("refined", refined.poses[:, :2])]:
    errors_cm = 100 * np.linalg.norm(xy - truth, axis=1)[found]
    print(f"{name}: {found.sum()} of {len(odd)} scans, RMSE {np.sqrt(np.mean(errors_cm**2)):.2f} cm")

import matplotlib.pyplot as plt  # noqa: E402

near = np.linalg.norm(scene.vertices[:, None, :2] - truth[::4], axis=2).min(axis=1) < 30
plt.scatter(*scene.vertices[near, :2].T, c=scene.vertices[near, 2], s=0.2, cmap="Greys")
plt.plot(*truth.T, "k-", label="true")
plt.plot(*path[found].T, "r.", label="localized")
plt.axis("equal")
plt.xlabel("x [m]")
plt.ylabel("y [m]")
plt.legend()
plt.savefig(sys.argv[2] if len(sys.argv) > 2 else "scene.png", dpi=150)
