"""Errors of a trajectory by evo (Grupp 2017), as JSON: errors.py ESTIMATE TRUTH, rows of KITTI in one frame.

Absolute errors with evo's three alignments; relative errors, by evo's definition of the error of a pair, of the pairs
of the KITTI benchmark: the second pose is the first whose distance along the truth is at least the length."""

import json
import sys
from copy import deepcopy

import numpy as np
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from evo.tools import file_interface


def read(path):
    """A trajectory whose rotations, which files have with few digits, are orthogonal as evo requires."""
    poses = file_interface.read_kitti_poses_file(path).poses_se3
    for pose in poses:
        u, _, v = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ v
    return PosePath3D(poses_se3=poses)


estimate, truth = (read(path) for path in sys.argv[1:3])


def absolute(aligned):
    result = {}
    for name, relation in [
        ("position_m", metrics.PoseRelation.translation_part),
        ("rotation_rad", metrics.PoseRelation.rotation_angle_rad),
    ]:
        ape = metrics.APE(relation)
        ape.process_data((truth, aligned))
        result[name] = {key: ape.get_all_statistics()[key] for key in ("rmse", "mean", "median", "max")}
        result[name]["end"] = float(ape.error[-1])
    return result


def segments(lengths, step):
    q, p = truth.poses_se3, estimate.poses_se3
    driven = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(truth.positions_xyz, axis=0), axis=1))])
    translations, rotations = [], []
    for length in lengths:
        for first in range(0, len(q), step):
            last = np.searchsorted(driven, driven[first] + length)
            if last >= len(q):
                break
            error = metrics.RPE.rpe_base(q[first], q[last], p[first], p[last])
            translations.append(np.linalg.norm(error[:3, 3]) / length)
            cosine = np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)
            rotations.append(np.degrees(np.arccos(cosine)) / length)
    if not translations:
        return None
    return {
        "translation_percent": 100 * np.mean(translations),
        "rotation_deg_per_m": np.mean(rotations),
        "segments": len(translations),
    }


first, rigid = deepcopy(estimate), deepcopy(estimate)
first.align_origin(truth)
rigid.align(truth)
print(
    json.dumps(
        {
            "none": absolute(estimate),
            "first": absolute(first),
            "rigid": absolute(rigid),
            "kitti_segments": segments(range(100, 900, 100), 10),
            "short_segments": segments([5, 10, 20, 50], 1),
        }
    )
)
