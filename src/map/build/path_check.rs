//! Plausibility of the poses of a drive: one wrong row would stretch a map over kilometres.

use crate::geometry::{FARTHEST_M, Pose3};

/// Poses that no car has driven, with the numbers of their frames.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum ImplausiblePath {
    #[error("the pose of frame {frame} is not finite or beyond any place on Earth")]
    NotOnEarth { frame: usize },
    #[error(
        "the pose of frame {frame} is wrong: it is {distance_m:.0} m from that of frame {previous}, and frame {next} is where it was expected; correct its row"
    )]
    Outlier {
        previous: usize,
        frame: usize,
        next: usize,
        distance_m: f64,
    },
    #[error(
        "the poses jump by {distance_m:.0} m from frame {previous} to frame {frame}; correct them, map both parts on their own, or allow it by max_step_m, now {max_step_m} m"
    )]
    Jump {
        previous: usize,
        frame: usize,
        distance_m: f64,
        max_step_m: f64,
    },
}

/// Checks that successive poses, with their frame numbers, are at most `max_step_m` apart.
pub fn check<'a>(
    poses: impl IntoIterator<Item = (usize, &'a Pose3)>,
    max_step_m: f64,
) -> Result<(), ImplausiblePath> {
    let poses: Vec<_> = (poses.into_iter())
        .map(|(frame, pose)| (frame, pose.translation.vector))
        .collect();
    for &(frame, position) in &poses {
        // Not a number is not within the limit either.
        let is_on_earth = position.iter().all(|m| m.abs() <= FARTHEST_M);
        if !is_on_earth {
            return Err(ImplausiblePath::NotOnEarth { frame });
        }
    }
    for (row, pair) in poses.windows(2).enumerate() {
        let [(previous, before), (frame, position)] = [pair[0], pair[1]];
        let distance_m = (position - before).norm();
        if distance_m <= max_step_m {
            continue;
        }
        if let Some(&(next, after)) = poses.get(row + 2)
            && (after - before).norm() <= 2.0 * max_step_m
            && (after - position).norm() > max_step_m
        {
            return Err(ImplausiblePath::Outlier {
                previous,
                frame,
                next,
                distance_m,
            });
        }
        return Err(ImplausiblePath::Jump {
            previous,
            frame,
            distance_m,
            max_step_m,
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_at(positions_m: &[f64]) -> Result<(), ImplausiblePath> {
        let poses: Vec<Pose3> = (positions_m.iter())
            .map(|&x| Pose3::translation(x, 0.0, 0.0))
            .collect();
        check(poses.iter().enumerate(), 50.0)
    }

    #[test]
    fn a_drive_is_plausible_and_one_wrong_row_and_a_jump_are_not() {
        check_at(&[0.0, 1.0, 2.0, 40.0, 41.0]).unwrap();
        check_at(&[]).unwrap();
        assert!(matches!(
            check_at(&[0.0, 1.0, 1002.0, 3.0, 4.0]),
            Err(ImplausiblePath::Outlier { frame: 2, .. })
        ));
        assert!(matches!(
            check_at(&[0.0, 1.0, 1002.0, 1003.0]),
            Err(ImplausiblePath::Jump { frame: 2, .. })
        ));
        for position in [f64::NAN, f64::INFINITY, 1e9] {
            assert!(matches!(
                check_at(&[0.0, position]),
                Err(ImplausiblePath::NotOnEarth { frame: 1 })
            ));
        }
    }
}
