"""Compares the errors of results with their covariances.

    python benches/consistency.py RESULT.npz ...

Prints, for the tracked frames of all results together from the 10th on, localized and refined, the mean of the normalized
squared error eᵀ Σ⁻¹ e of e = (x, y, heading), which is 3 for an exact covariance, the share of frames inside the region that
should hold 95 % (χ² with 3 degrees of freedom: 7.815), and the root mean square of the position.
"""

import sys

import numpy as np

TRACKING = 1
WARM_UP = 10
QUANTILE = 7.815


def squared_errors(result, poses, covariances):
    """Normalized squared errors, and squared distances [m²], of the tracked frames of a result."""
    is_counted = result["states"] == TRACKING
    is_counted[:WARM_UP] = False
    error = (result[poses] - result["ground_truth"])[is_counted]
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    covariance = result[covariances][is_counted].reshape(-1, 3, 3)
    whitened = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    return (error * whitened).sum(1), (error[:, :2] ** 2).sum(1)


def consistency(files):
    """Rows of name, frames, mean squared error, share inside, and RMSE [m]."""
    results = [dict(np.load(file)) for file in files]
    for name, poses, covariances in [
        ("localize", "estimates", "covariances"),
        ("refine", "refined", "refined_covariances"),
    ]:
        of_all = [squared_errors(it, poses, covariances) for it in results if covariances in it]
        if of_all:
            squared, distances = (np.concatenate(column) for column in zip(*of_all))
            inside = np.mean(squared <= QUANTILE)
            yield name, len(squared), squared.mean(), inside, np.sqrt(distances.mean())


if __name__ == "__main__":
    for name, frames, squared, inside, rmse_m in consistency(sys.argv[1:]):
        print(f"{name}: {frames} frames, {squared:.2f}, {100 * inside:.1f} % inside, {100 * rmse_m:.2f} cm")
