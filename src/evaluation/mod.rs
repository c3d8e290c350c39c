//! How good a trajectory is: metrics with units, reports, result files.
