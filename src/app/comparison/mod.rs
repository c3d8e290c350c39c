//! Many runs beside each other: which configuration is better, by how much, and whether that is
//! more than chance.
//!
//! A [`RunRecord`] is what one run leaves for the comparison. [`measures`] takes numbers out of it,
//! [`spread`] tells their mean and scatter over seeds and sequences, [`paired`] whether two
//! configurations differ, and [`tables`] puts all that into rows and columns.
//!
//! What a run is measured by, with e = t_estimate − t_truth in the plane, θ the heading, s the distance
//! driven, and the mean over the frames that count:
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
//! success                    from the first of ten frames in a row with |e| ≤ 0.5 m and a heading
//!                            error ≤ 2 degrees on, all frames are like that
//! range-mcl's success        |e| < 5 m at every 100th frame from the 100th on; Chen et al. 2021
//! ```
//!
//! Relative pose errors and KITTI's segment errors are in [`pose_error`](super::pose_error).

pub mod measures;
pub mod paired;
pub mod record;
pub mod spread;
pub mod success;
pub mod tables;

pub use measures::Measure;
pub use paired::paired_difference;
pub use record::{Outcome, RunId, RunRecord};
pub use spread::mean_with_spread;
pub use success::success_rate;
pub use tables::{Comparison, Contrast, Variant};
