//! Origin of a mesh from elsewhere: near its vertices, so that single precision resolves millimetres.
//!
//! ```text
//! p_map = p_file − origin        origin = 0 for coordinates up to 8 km, else a whole number of kilometres
//! ```

use glam::{DVec3, Vec3};

use super::mesh_error::MeshFileProblem;
use crate::geometry::FARTHEST_M;

/// Largest coordinate that single precision resolves to half a millimetre [m].
pub(crate) const PRECISE_M: f64 = 8192.0;

/// Precision of the coordinates in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Precision {
    Single,
    Double,
}

/// Returns the origin of the map in the frame of the file, and the positions relative to it.
pub(crate) fn relative(
    positions: &[DVec3],
    precision: Precision,
) -> Result<(DVec3, Vec<Vec3>), MeshFileProblem> {
    check(positions)?;
    let min = (positions.iter().copied()).fold(DVec3::INFINITY, DVec3::min);
    let max = (positions.iter().copied()).fold(DVec3::NEG_INFINITY, DVec3::max);
    let farthest_m = min.abs().max(max.abs()).max_element();
    if positions.is_empty() || farthest_m <= PRECISE_M {
        let positions = positions.iter().map(|position| position.as_vec3());
        return Ok((DVec3::ZERO, positions.collect()));
    }
    require_precision(farthest_m, precision)?;
    let origin = ((min + max) / 2000.0).round() * 1000.0;
    let origin = DVec3::select(
        min.abs().max(max.abs()).cmpgt(DVec3::splat(PRECISE_M)),
        origin,
        DVec3::ZERO,
    );
    let positions = positions
        .iter()
        .map(|&position| (position - origin).as_vec3());
    Ok((origin, positions.collect()))
}

/// Requires that the coordinates of a file resolve two centimetres.
fn require_precision(farthest_m: f64, precision: Precision) -> Result<(), MeshFileProblem> {
    const COARSEST_M: f64 = 0.02;
    let above = f32::from_bits((farthest_m as f32).to_bits() + 1);
    let resolution_m = f64::from(above) - f64::from(farthest_m as f32);
    if precision == Precision::Single && resolution_m > COARSEST_M {
        Err(MeshFileProblem::TooCoarse {
            farthest_m,
            resolution_cm: 100.0 * resolution_m,
        })
    } else {
        Ok(())
    }
}

/// Checks that vertices are finite and on Earth.
pub(crate) fn check(positions: &[DVec3]) -> Result<(), MeshFileProblem> {
    for (vertex, &position) in positions.iter().enumerate() {
        if !position.is_finite() {
            return Err(MeshFileProblem::NotFinite(vertex));
        }
        if position.abs().max_element() > FARTHEST_M {
            return Err(MeshFileProblem::TooFar { vertex, position });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_of_utm_keep_their_millimetres() {
        let corner = DVec3::new(448_123.456, 5_411_987.654, 312.125);
        let positions: Vec<DVec3> = (0..5).map(|i| corner + 0.001 * f64::from(i)).collect();
        let (origin, relative) = relative(&positions, Precision::Double).unwrap();
        assert_eq!(origin, DVec3::new(448_000.0, 5_412_000.0, 0.0));
        for (position, relative) in positions.iter().zip(relative) {
            assert!((origin + relative.as_dvec3() - position).length() < 1e-4);
        }
    }

    #[test]
    fn near_coordinates_are_unchanged() {
        let positions = [DVec3::new(-5000.0, 0.25, 8000.0), DVec3::ONE];
        let (origin, relative) = relative(&positions, Precision::Single).unwrap();
        assert_eq!(origin, DVec3::ZERO);
        assert_eq!(relative, positions.map(|position| position.as_vec3()));
    }

    #[test]
    fn single_precision_that_lost_the_centimetres_is_an_error() {
        let far = |x: f64| relative(&[DVec3::new(x, 0.0, 0.0)], Precision::Single);
        assert!(far(200_000.0).is_ok());
        let message = far(5_411_987.5).unwrap_err().to_string();
        assert!(message.contains("50 cm"), "{message}");
    }
}
