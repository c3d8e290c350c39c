//! The pixels of directions.
//!
//! The rows of a [`LidarModel`] are intervals of the sine of the elevation, z / r, found in a table: no angle but the
//! azimuth is computed per point.

use std::f32::consts::PI;

use super::model::LidarModel;
use crate::geometry::{Vec3, fast_atan2};

/// Entries of the table over the sines from 1 to −1.
const CELLS: usize = 2048;

/// Projection of directions to pixels.
#[derive(Clone, Debug)]
pub struct Projection {
    width: usize,
    /// Least and greatest sine of the elevation of each row, from the top.
    rows: Vec<[f32; 2]>,
    /// The first row that reaches below the top of each cell.
    first_rows: Vec<u16>,
}

impl Projection {
    /// The projection of an image.
    pub fn of(model: &LidarModel) -> Self {
        let rows = match &model.elevations {
            Some(elevations) => rows_of_beams(elevations, model),
            None => even_rows(model),
        };
        let mut row = 0;
        let first_row = |cell: usize| {
            let top = 1.0 - 2.0 * cell as f32 / CELLS as f32;
            while row < rows.len() && rows[row][0] > top {
                row += 1;
            }
            row as u16
        };
        Self {
            width: model.width,
            first_rows: (0..CELLS).map(first_row).collect(),
            rows,
        }
    }

    /// Row-major index of the pixel of a direction of any length; `None` above or below the field of
    /// view.
    #[inline]
    pub fn pixel_of(&self, direction: Vec3) -> Option<usize> {
        let azimuth_rad = fast_atan2(direction.y, direction.x);
        self.pixel_at(direction.z / direction.length(), azimuth_rad)
    }

    /// The same of the sine of an elevation and an azimuth.
    #[inline]
    pub(crate) fn pixel_at(&self, sine: f32, azimuth_rad: f32) -> Option<usize> {
        let row = self.row_of(sine)?;
        let column = 0.5 * (1.0 - azimuth_rad / PI) * self.width as f32;
        // An azimuth of exactly -π wraps to column 0.
        Some(row * self.width + column as usize % self.width)
    }

    /// Row of the sine of an elevation; `None` outside the field of view or if it is not a number.
    #[inline]
    fn row_of(&self, sine: f32) -> Option<usize> {
        let cell = (0.5 * (1.0 - sine) * CELLS as f32) as usize;
        // The sine may be rounded into the cell above.
        let mut row = usize::from(self.first_rows[cell.min(CELLS - 1).saturating_sub(1)]);
        while self.rows.get(row)?[0] > sine {
            row += 1;
        }
        (sine <= self.rows[row][1]).then_some(row)
    }
}

/// Rows that divide the field of view evenly; a row has its upper end.
fn even_rows(model: &LidarModel) -> Vec<[f32; 2]> {
    let sine = |row: usize| {
        let share = row as f32 / model.height as f32;
        (model.fov_up_rad() - share * model.fov_rad()).sin()
    };
    (0..model.height)
        .map(|row| [sine(row + 1).next_up(), sine(row)])
        .collect()
}

/// Rows around beams: each direction belongs to the nearest beam that is not farther away than half its spacing, of two
/// equally near ones to the upper.
fn rows_of_beams(elevations_deg: &[f32], model: &LidarModel) -> Vec<[f32; 2]> {
    let middle = |row: usize| 0.5 * (elevations_deg[row] + elevations_deg[row + 1]);
    (0..elevations_deg.len())
        .map(|row| {
            let half_deg = 0.5 * model.row_spacing_rad(row).to_degrees();
            let mut ends = [
                elevations_deg[row] - half_deg,
                elevations_deg[row] + half_deg,
            ];
            if row + 1 < elevations_deg.len() {
                ends[0] = ends[0].max(middle(row));
            }
            if row > 0 {
                ends[1] = ends[1].min(middle(row - 1));
            }
            ends.map(|deg| deg.clamp(-90.0, 90.0).to_radians().sin())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Row of an elevation by its definition; `None` outside the field of view.
    fn row_by_angle(model: &LidarModel, elevation_deg: f32) -> Option<usize> {
        let Some(elevations) = &model.elevations else {
            let share = (model.fov_up_rad() - elevation_deg.to_radians()) / model.fov_rad();
            let row = share * model.height as f32;
            return (row >= 0.0 && row < model.height as f32).then_some(row as usize);
        };
        let distance = |row: &usize| (elevations[*row] - elevation_deg).abs();
        let row = (0..elevations.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        (distance(&row) <= 0.5 * model.row_spacing_rad(row).to_degrees()).then_some(row)
    }

    #[test]
    fn rows_are_those_of_the_angles() {
        let uneven: Vec<f32> = (0..40)
            .map(|row| 30.0 - 0.04 * (row * row) as f32)
            .collect();
        let models = [
            LidarModel::default(),
            LidarModel {
                fov_up: 90.0,
                fov_down: -90.0,
                height: 1000,
                ..LidarModel::default()
            },
            LidarModel {
                height: uneven.len(),
                elevations: Some(uneven.into()),
                ..LidarModel::default()
            },
            LidarModel {
                height: 5,
                elevations: Some([80.0, 12.0, 11.9, 0.0, -60.0].into()),
                ..LidarModel::default()
            },
        ];
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for model in models {
            let projection = Projection::of(&model);
            for _ in 0..20_000 {
                let deg: f32 = rng.random_range(-89.0..89.0);
                // At the ends of a row rounding decides.
                let near = [deg - 0.01, deg, deg + 0.01].map(|deg| row_by_angle(&model, deg));
                if near[0] == near[2] {
                    let found = projection.row_of(deg.to_radians().sin());
                    assert_eq!(found, near[1], "{deg}");
                }
            }
        }
    }
}
