//! The unit of the coordinates of a map, which files of meshes do not name.

use crate::geometry::Aabb;

/// What speaks against the metre as the unit of a map with these bounds; `None` if nothing does.
///
/// Nothing that a car drives in is less than 2 m across. A map of more than 20 km is a long drive or one in millimetres:
/// in the latter, a wall of 1 m is 1 km high, and more than the roads of such a drive rise. No map of one drive is more
/// than 100 km across, and one in millimetres of 100 m is.
pub(crate) fn unit_doubt(bounds: &Aabb) -> Option<String> {
    const SMALLEST_M: f32 = 2.0;
    const LONG_DRIVE_M: f32 = 20_000.0;
    const HIGHEST_M: f32 = 1_000.0;
    const LARGEST_M: f32 = 100_000.0;
    let extent_m = bounds.size().max_element();
    let is_large = extent_m > LONG_DRIVE_M && bounds.size().z > HIGHEST_M;
    let (extent, unit, scale) = if is_large || extent_m > LARGEST_M {
        (format!("{:.0} km", extent_m / 1000.0), "millimetres", 0.001)
    } else if extent_m < SMALLEST_M {
        (format!("{extent_m:.2} m"), "kilometres", 1000.0)
    } else {
        return None;
    };
    Some(format!(
        "the extent is {extent}: are the coordinates in {unit}? Those of a map are in metres, scale it by {scale} then"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Vec3;

    #[test]
    fn the_unit_of_maps_in_metres_is_not_doubted_and_that_of_others_is() {
        let doubt = |size: [f32; 3]| {
            let min = Vec3::new(-10.0, 5.0, -2.0);
            let max = min + Vec3::from_array(size);
            unit_doubt(&Aabb { min, max })
        };
        // A car park, a street, a town, a long drive, one in the Alps.
        for size in [
            [40.0, 20.0, 3.0],
            [116.0, 40.0, 12.0],
            [6e3, 4e3, 150.0],
            [7e4, 2e4, 600.0],
            [1.5e4, 1e4, 2.2e3],
        ] {
            assert_eq!(doubt(size), None, "{size:?}");
        }
        for size in [[116.0, 40.0, 12.0], [30.0, 12.0, 2.5], [150.0, 9.0, 0.1]] {
            let text = doubt(size.map(|side| 1000.0 * side)).unwrap();
            assert!(
                text.contains("km: are the coordinates in millimetres?"),
                "{text}"
            );
            let text = doubt(size.map(|side| 0.001 * side)).unwrap();
            assert!(
                text.contains("m: are the coordinates in kilometres?"),
                "{text}"
            );
        }
    }
}
