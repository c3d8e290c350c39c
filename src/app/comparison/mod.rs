//! Comparison of configurations: which one is better, by how much, and whether the difference
//! exceeds chance. Sequences × configurations × seeds are executed and summarized in tables.
//!
//! ```text
//! comparison.yml
//!   | plan        all runs with their effective configurations; overrides in the order
//!   |             defaults <- base <- sequence <- configuration <- seed
//!   v
//! sequences/NAME/drive_1, drive_2          simulated drives
//!   | keys        hash of all that a stage depends on: configuration without paths, contents of
//!   |             the inputs, executable (BLAKE3)
//!   v
//! shared/maps/KEY/map.ply                  one per map key
//! shared/localizations/KEY/...             one per map, filter configuration and seed
//!   | execute     one run after another; each uses all threads
//!   v
//! runs/SEQUENCE/CONFIGURATION/SEED/        effective_build_map.yml effective_localization.yml
//!   |                                      effective_refinement.yml log.txt localization.npz
//!   |                                      report.html plots/, finally run.json
//!   | collect     tables and page of the finished runs
//!   v
//! report.html tables.txt tables.md comparison.json TABLE.csv plots/ effective_comparison.yml
//! ```
//!
//! A run is skipped if its `run.json` has the current key, so that an interrupted comparison
//! resumes. Shared results are created under a file lock: the runs of one comparison may be
//! separate processes, on one or several machines.
//!
//! Measures of a run, with e = t_estimate − t_truth in the plane, heading θ, driven distance s, and
//! means over the evaluated frames:
//!
//! ```text
//! average positional error   mean |e|                          absolute pose error without alignment,
//!                                                              Sturm et al. 2012, eq. 3, in the plane
//! RMSE x, y, heading         √ mean e_x²,  √ mean e_y²,  √ mean wrap(θ_estimate − θ_truth)²
//! jitter                     √ mean |e_k − e_k−1|²             relative pose error over one frame,
//!                                                              without rotation
//! smoothness                 −ln(T³ / v_peak² · ∫ |d³p/dt³|² dt)   Hogan and Sternad 2009
//! drift                      slope of |e| against s, and against time (least squares)
//! mean pose change           mean |p_k − p_k−1|,  mean |wrap(θ_k − θ_k−1)|
//! success                    |e| ≤ 0.5 m and heading error ≤ 2 degrees in ten consecutive frames
//!                            and in all frames after them
//! range-mcl's success        |e| < 5 m at every 100th frame from the 100th on; Chen et al. 2021
//! ```
//!
//! Relative pose errors and KITTI's segment errors: [`pose_error`](crate::evaluation::pose_error).

// The command.
pub mod compare;
// Runs and their execution.
mod config;
mod execute;
mod keys;
mod layout;
mod plan;
mod record;
// Evaluation of the records.
mod cases;
mod collect;
mod formats;
mod measures;
mod page;
mod pictures;
mod results;
mod statistics;
mod table;
mod tables;

#[cfg(test)]
mod table_tests;

pub use collect::{ComparisonFile, collect};
pub use config::ComparisonConfig;
pub use execute::Executor;
pub use layout::Layout;
pub use plan::{PlannedRun, planned_runs};
pub use record::{Outcome, RunId};
