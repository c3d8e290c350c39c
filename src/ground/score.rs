//! How well ground was told from the rest, against SemanticKITTI classes.

use serde::{Deserialize, Serialize};

/// Which classes are ground, and which are left out of the score. The two differ by about
/// 3.4 points of F1: never mix them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Protocol {
    /// Of the Patchwork++ repository (Lee, Lim and Myung, IROS 2022): unlabelled, outliers and
    /// vegetation do not count.
    #[default]
    PatchworkPlusPlus,
    /// Of Patchwork (Lim, Oh and Myung, RA-L 2021): vegetation counts, as ground where it is low.
    Patchwork,
}

const UNLABELLED: u16 = 0;
const OUTLIER: u16 = 1;
const VEGETATION: u16 = 70;
/// Road, parking, sidewalk, other ground, lane marking, terrain.
const GROUND: [u16; 6] = [40, 44, 48, 49, 60, 72];
/// Vegetation below this height in the lidar frame is ground for [`Protocol::Patchwork`] [m].
const LOW_VEGETATION_M: f32 = -1.3;

impl Protocol {
    /// Whether a point of a class at height `z` in the lidar frame [m] is ground; `None` where
    /// it does not count.
    pub fn truth(self, class: u16, z: f32) -> Option<bool> {
        match (class, self) {
            (UNLABELLED | OUTLIER, _) | (VEGETATION, Self::PatchworkPlusPlus) => None,
            (VEGETATION, Self::Patchwork) => Some(z < LOW_VEGETATION_M),
            _ => Some(GROUND.contains(&class)),
        }
    }
}

/// Counts of points; scores of several scans add up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct GroundScore {
    /// Ground called ground.
    pub true_positives: u64,
    /// Other things called ground.
    pub false_positives: u64,
    /// Ground called something else.
    pub false_negatives: u64,
    /// Other things called something else.
    pub true_negatives: u64,
}

impl GroundScore {
    /// Counts one point.
    pub fn add(&mut self, called_ground: bool, is_ground: bool) {
        *match (called_ground, is_ground) {
            (true, true) => &mut self.true_positives,
            (true, false) => &mut self.false_positives,
            (false, true) => &mut self.false_negatives,
            (false, false) => &mut self.true_negatives,
        } += 1;
    }

    /// Adds the counts of another scan.
    pub fn merge(&mut self, other: &Self) {
        self.true_positives += other.true_positives;
        self.false_positives += other.false_positives;
        self.false_negatives += other.false_negatives;
        self.true_negatives += other.true_negatives;
    }

    /// Share of what was called ground that is, 0 to 1; NaN where nothing was.
    pub fn precision(&self) -> f64 {
        share(self.true_positives, self.false_positives)
    }

    /// Share of the ground that was called so, 0 to 1; NaN where there is none.
    pub fn recall(&self) -> f64 {
        share(self.true_positives, self.false_negatives)
    }

    /// Harmonic mean of precision and recall, 0 to 1.
    pub fn f1(&self) -> f64 {
        share(
            2 * self.true_positives,
            self.false_positives + self.false_negatives,
        )
    }

    /// Intersection over union, 0 to 1.
    pub fn iou(&self) -> f64 {
        share(
            self.true_positives,
            self.false_positives + self.false_negatives,
        )
    }
}

fn share(right: u64, wrong: u64) -> f64 {
    right as f64 / (right + wrong) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scores_follow_from_the_counts() {
        let mut score = GroundScore::default();
        for (called, is, times) in [
            (true, true, 6),
            (true, false, 2),
            (false, true, 1),
            (false, false, 9),
        ] {
            (0..times).for_each(|_| score.add(called, is));
        }
        let mut twice = score;
        twice.merge(&score);
        for score in [score, twice] {
            assert_eq!(score.precision(), 6.0 / 8.0);
            assert_eq!(score.recall(), 6.0 / 7.0);
            assert_eq!(score.f1(), 12.0 / 15.0);
            assert_eq!(score.iou(), 6.0 / 9.0);
        }
    }

    #[test]
    fn the_protocols_differ_in_vegetation_alone() {
        for class in 0..260 {
            for z in [-1.6, 0.5] {
                let (new, old) = (Protocol::PatchworkPlusPlus, Protocol::Patchwork);
                assert_eq!(
                    new.truth(class, z) == old.truth(class, z),
                    class != VEGETATION
                );
            }
        }
        assert_eq!(Protocol::Patchwork.truth(VEGETATION, -1.6), Some(true));
        assert_eq!(Protocol::Patchwork.truth(VEGETATION, 0.5), Some(false));
    }
}
