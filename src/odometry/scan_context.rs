//! Descriptors of places, by which they are recognized from any heading.
//!
//! A polar image of the surroundings: per ring of distance and sector of azimuth the height of the highest point. A
//! turn of the sensor shifts the sectors, so two places are compared at the shift at which the columns of
//! their images are most similar.
//!
//! Kim and Kim, *Scan Context: Egocentric Spatial Descriptor for ScanContext Recognition within 3D Point Cloud Map*
//! (IROS 2018), eq. 3 to 8.

use std::f64::consts::TAU;

use super::sampling::TimedPoint;

const RINGS: usize = 20;
const SECTORS: usize = 60;

/// Descriptor of the surroundings of a sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanContext {
    /// Per sector the heights of its rings, as a vector of length one; zeros where nothing is.
    columns: Vec<[f32; RINGS]>,
}

impl ScanContext {
    /// Describes the points around a sensor, up to a distance.
    pub fn new(points: &[TimedPoint], radius_m: f64) -> Self {
        /// Share of the points that are lower than the zero of the heights: the ground.
        const LOW: f64 = 0.05;
        let radius_m = radius_m as f32;
        let near = || {
            (points.iter().map(|point| point.position))
                .filter(move |point| point.truncate().length() < radius_m)
        };
        let mut columns = vec![[0.0_f32; RINGS]; SECTORS];
        let mut heights: Vec<f32> = near().map(|point| point.z).collect();
        let rank = (LOW * heights.len() as f64) as usize;
        if heights.is_empty() {
            return Self { columns };
        }
        let low = *heights.select_nth_unstable_by(rank, f32::total_cmp).1;
        for point in near() {
            let turns = (f64::from(point.y).atan2(point.x.into()) / TAU).rem_euclid(1.0);
            let sector = ((turns * SECTORS as f64) as usize).min(SECTORS - 1);
            let ring = (point.truncate().length() / radius_m * RINGS as f32) as usize;
            let height = &mut columns[sector][ring.min(RINGS - 1)];
            *height = height.max(point.z - low);
        }
        for column in &mut columns {
            let norm = column
                .iter()
                .map(|height| height * height)
                .sum::<f32>()
                .sqrt();
            column
                .iter_mut()
                .for_each(|height| *height /= norm.max(f32::MIN_POSITIVE));
        }
        Self { columns }
    }

    /// Mean similarity of the columns of two places, 0 to 1, at the turn where it is greatest, and this turn about the
    /// vertical: the heading of the other place in the frame of this one [rad].
    pub fn similarity(&self, other: &Self) -> (f64, f64) {
        let best = (0..SECTORS)
            .map(|shift| (self.similarity_at(other, shift), shift))
            .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
        let (similarity, shift) = best.unwrap_or((0.0, 0));
        (similarity.into(), TAU * shift as f64 / SECTORS as f64)
    }

    fn similarity_at(&self, other: &Self, shift: usize) -> f32 {
        let mut sum = 0.0;
        for (sector, column) in other.columns.iter().enumerate() {
            let own = &self.columns[(sector + shift) % SECTORS];
            sum += own.iter().zip(column).map(|(a, b)| a * b).sum::<f32>();
        }
        sum / SECTORS as f32
    }
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};

    use super::*;

    /// Walls and poles around a sensor.
    fn surroundings(seed: u64) -> Vec<TimedPoint> {
        let noise = |n: u64| ((seed * 1000 + n) as f64 * 12.9898).sin().abs() as f32;
        (0..60)
            .flat_map(|object| {
                let (angle, distance) = (
                    noise(object) * std::f32::consts::TAU,
                    5.0 + 40.0 * noise(object + 100),
                );
                let height = 1.0 + 8.0 * noise(object + 200);
                (0..40).map(move |step| {
                    let along = 0.1 * step as f32;
                    Vec3::new(
                        distance * angle.cos() + along,
                        distance * angle.sin() - along,
                        height * (step as f32 / 40.0) - 1.7,
                    )
                })
            })
            .map(|position| TimedPoint {
                position,
                time_s: 0.0,
            })
            .collect()
    }

    #[test]
    fn a_place_is_recognized_from_any_heading() {
        let there = surroundings(1);
        let place = ScanContext::new(&there, 50.0);
        for turn in [0.0_f32, 0.7, 2.0, 3.2, 5.5] {
            let turned: Vec<TimedPoint> = (there.iter())
                .map(|point| TimedPoint {
                    position: Quat::from_rotation_z(-turn) * point.position,
                    ..*point
                })
                .collect();
            let (similarity, found) = place.similarity(&ScanContext::new(&turned, 50.0));
            let error = (found - f64::from(turn) + 0.5 * TAU).rem_euclid(TAU) - 0.5 * TAU;
            let (of_other, _) = place.similarity(&ScanContext::new(&surroundings(2), 50.0));
            assert!(
                error.abs() < 0.11 && similarity > of_other + 0.05,
                "{turn} {found} {similarity} {of_other}"
            );
        }
    }

    #[test]
    fn nothing_is_similar_to_nothing() {
        let empty = ScanContext::new(&[], 50.0);
        assert_eq!(empty.similarity(&empty).0, 0.0);
    }
}
