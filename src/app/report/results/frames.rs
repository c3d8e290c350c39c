//! `frames.csv`: one row per frame, units in the header, empty cells where nothing is known.

use std::path::Path;

use anyhow::Result;
use nalgebra::Matrix3;

use super::localization_results::LocalizationResults;
use super::trusted::with_gaps;
use crate::app::run::output;
use crate::evaluation::trust::Axes;
use crate::evaluation::{PlanarError, drift};
use crate::geometry::{Pose2, Pose3, distances_m};
use crate::localization::State;

/// Writes the table; of a trajectory without particles, that of its errors in space. Nothing without estimates.
pub fn write_frames_csv(path: &Path, results: &LocalizationResults) -> Result<()> {
    match (&results.estimates, &results.estimates_in_space) {
        (_, Some(estimates)) if results.particles.is_empty() => {
            write_trajectory(path, results, estimates)
        }
        (Some(estimates), _) => write_localization(path, results, estimates),
        _ => Ok(()),
    }
}

/// A cost or an agreement, which are -1 in results where they are unknown, else not a number.
fn known(value: f64) -> f64 {
    if value < 0.0 { f64::NAN } else { value }
}

/// Writes poses, errors and states of the filter and of the refinement.
fn write_localization(
    path: &Path,
    results: &LocalizationResults,
    estimates: &[Pose2],
) -> Result<()> {
    let truth = results.ground_truth.as_deref();
    let refined = results.refined.as_deref();
    let covariances = results.covariances.as_deref();
    let (trajectory, trusted) = (results.trajectory(estimates), results.trusted());
    let trajectory = with_gaps(&trajectory, &trusted);
    let driven_m = distances_m(truth.unwrap_or(&trajectory));
    let word = |&number: &u8| {
        State::from_number(number).map_or_else(|| number.to_string(), |it| it.word().to_owned())
    };
    let particles: Vec<usize> = (0..results.particles.len())
        .map(|row| results.particles.count(row))
        .collect();
    let particles = (!particles.is_empty()).then_some(&*particles);
    let mut table = FrameTable::empty(results.len());
    table.add("frame", Some(&results.frames), usize::to_string);
    table.add_numbers("time_s", results.times_s.as_deref(), |time_s| *time_s);
    table.add_numbers("distance_m", Some(&driven_m), |distance_m| *distance_m);
    table.add_poses("truth", truth);
    table.add_poses("mcl", Some(estimates));
    table.add_errors("mcl", Some(estimates).zip(truth));
    table.add_deviations(covariances, estimates);
    table.add_poses("refined", refined);
    table.add_errors("refined", refined.zip(truth));
    table.add("particles", particles, usize::to_string);
    let agreements = results.agreements.as_deref();
    table.add_numbers("agreement", agreements, |share| known(*share));
    let places = results.places.as_deref();
    table.add_numbers("places", places, |places| *places);
    table.add("state", results.states.as_deref(), word);
    table.add_poses("trajectory", Some(&trajectory));
    table.add("refined_state", results.refined_states.as_deref(), word);
    for (names, column) in [
        (
            ["cost_before_m", "cost_after_m"],
            &results.refinement_costs_m,
        ),
        (
            ["agreement_before", "agreement_after"],
            &results.refinement_agreements,
        ),
    ] {
        for (moment, name) in names.into_iter().enumerate() {
            table.add_numbers(name, column.as_deref(), move |pair| known(pair[moment]));
        }
    }
    for (name, runtimes_s) in [
        ("runtime_ms", &results.runtimes_s),
        ("refine_runtime_ms", &results.refine_runtimes_s),
    ] {
        table.add_numbers(name, runtimes_s.as_deref(), |time_s| 1e3 * time_s);
    }
    table.save(path)
}

/// Writes poses in space and their errors against the distance driven.
fn write_trajectory(path: &Path, results: &LocalizationResults, estimates: &[Pose3]) -> Result<()> {
    let truth = results.ground_truth_in_space.as_deref();
    let errors = truth.map(|truth| drift(estimates, truth));
    let errors = errors.as_deref();
    let mut table = FrameTable::empty(results.len());
    table.add("frame", Some(&results.frames), usize::to_string);
    table.add_numbers("time_s", results.times_s.as_deref(), |time_s| *time_s);
    table.add_numbers("distance_m", errors, |error| error.distance_m);
    for (name, poses) in [("truth", truth), ("estimate", Some(estimates))] {
        for (axis, letter) in ["x", "y", "z"].into_iter().enumerate() {
            table.add_numbers(format!("{name}_{letter}_m"), poses, move |pose| {
                pose.translation.vector[axis]
            });
        }
    }
    table.add_numbers("position_error_m", errors, |error| error.position_m);
    table.add_numbers("heading_error_deg", errors, |error| {
        error.heading_rad.to_degrees()
    });
    table.add_numbers("rotation_error_deg", errors, |error| {
        error.rotation_rad.to_degrees()
    });
    table.save(path)
}

/// Columns with a title and one cell per frame, which are made when they are written.
pub struct FrameTable<'a> {
    rows: usize,
    columns: Vec<(String, Cell<'a>)>,
}

/// The title of a column, and its number.
type Titled<T> = (&'static str, fn(&T) -> f64);

/// The cell of a row.
type Cell<'a> = Box<dyn Fn(usize) -> String + 'a>;

impl<'a> FrameTable<'a> {
    /// A table of a number of rows without columns.
    pub fn empty(rows: usize) -> Self {
        Self {
            rows,
            columns: Vec::new(),
        }
    }

    /// Adds a column with a cell per item, or with empty cells.
    pub fn add<T>(
        &mut self,
        title: impl Into<String>,
        items: Option<&'a [T]>,
        cell: impl Fn(&T) -> String + 'a,
    ) {
        let cell: Cell = match items {
            Some(items) => Box::new(move |row| cell(&items[row])),
            None => Box::new(|_| String::new()),
        };
        self.columns.push((title.into(), cell));
    }

    fn add_numbers<T>(
        &mut self,
        title: impl Into<String>,
        items: Option<&'a [T]>,
        number: impl Fn(&T) -> f64 + 'a,
    ) {
        self.add_rows(title, items.map(|it| move |row: usize| number(&it[row])));
    }

    /// Adds a column with a number per row, where it is known.
    fn add_rows(&mut self, title: impl Into<String>, number: Option<impl Fn(usize) -> f64 + 'a>) {
        let cell = move |row| match number.as_ref().map_or(f64::NAN, |number| number(row)) {
            number if number.is_nan() => String::new(),
            number => format!("{number:.4}"),
        };
        self.columns.push((title.into(), Box::new(cell)));
    }

    fn add_poses(&mut self, name: &str, poses: Option<&'a [Pose2]>) {
        self.add_numbers(format!("{name}_x_m"), poses, |pose| pose.translation.x);
        self.add_numbers(format!("{name}_y_m"), poses, |pose| pose.translation.y);
        self.add_numbers(format!("{name}_heading_deg"), poses, |pose| {
            pose.rotation.angle().to_degrees()
        });
    }

    /// Adds the errors of poses against the true ones.
    fn add_errors(&mut self, name: &str, poses: Option<(&'a [Pose2], &'a [Pose2])>) {
        let errors: [Titled<PlanarError>; 4] = [
            ("position_error_m", PlanarError::distance_m),
            ("along_error_m", |error| error.along_m),
            ("across_error_m", |error| error.across_m),
            ("heading_error_deg", |error| error.turn_rad.to_degrees()),
        ];
        for (title, number) in errors {
            let error = poses.map(|(poses, truth)| {
                move |row: usize| number(&PlanarError::between(&poses[row], &truth[row]))
            });
            self.add_rows(format!("{name}_{title}"), error);
        }
    }

    /// Adds the axes of the covariance of the position: a long one is a direction that the scene does not constrain.
    fn add_deviations(&mut self, covariances: Option<&'a [Matrix3<f64>]>, poses: &'a [Pose2]) {
        let axes: [Titled<Axes>; 3] = [
            ("mcl_sigma_long_m", |axes| axes.long_m),
            ("mcl_sigma_short_m", |axes| axes.short_m),
            ("mcl_long_axis_from_forward_deg", |axes| {
                axes.long_from_forward_rad.to_degrees()
            }),
        ];
        for (title, number) in axes {
            let axis =
                covariances.map(|all| move |row: usize| number(&Axes::new(&all[row], &poses[row])));
            self.add_rows(title, axis);
        }
        self.add_numbers("mcl_sigma_heading_deg", covariances, |covariance| {
            covariance[(2, 2)].max(0.0).sqrt().to_degrees()
        });
    }

    /// Writes the table as CSV.
    pub fn save(&self, path: &Path) -> Result<()> {
        output::write_file(path, |file| {
            let mut writer = csv::Writer::from_writer(file);
            writer.write_record(self.columns.iter().map(|(title, _)| title))?;
            for row in 0..self.rows {
                writer.write_record(self.columns.iter().map(|(_, cell)| cell(row)))?;
            }
            writer.flush()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::ParticleLog;
    use super::*;

    #[test]
    fn a_row_has_a_cell_for_every_title_and_unknown_ones_are_empty() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frames.csv");
        let truth: Vec<Pose2> = (0..3)
            .map(|k| Pose2::translation(f64::from(k), 0.0))
            .collect();
        let estimates: Vec<Pose2> = truth
            .iter()
            .map(|pose| pose * Pose2::new([0.5, 0.25].into(), 0.1))
            .collect();
        let mut particles = ParticleLog::new(10, Path::new("."));
        (0..3).for_each(|_| particles.push_frame(&[[1.0; 4]; 2]).unwrap());
        let results = LocalizationResults {
            frames: vec![1, 3, 5].into(),
            particles,
            estimates: Some(estimates.into()),
            ground_truth: Some(truth.into()),
            runtimes_s: Some(vec![0.01, 0.02, 0.03].into()),
            covariances: Some(vec![Matrix3::from_diagonal(&[0.01, 4.0, 1e-4].into()); 3].into()),
            ..LocalizationResults::default()
        };
        write_frames_csv(&path, &results).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split(',').collect()).collect();
        assert_eq!(lines.len(), 4);
        let cell = |row: usize, title: &str| {
            let place = lines[0].iter().position(|found| *found == title).unwrap();
            assert_eq!(lines[row].len(), lines[0].len());
            lines[row][place]
        };
        assert_eq!(cell(2, "frame"), "3");
        assert_eq!(cell(2, "distance_m"), "1.0000");
        assert_eq!(cell(2, "mcl_along_error_m"), "0.5000");
        assert_eq!(cell(2, "mcl_across_error_m"), "0.2500");
        assert_eq!(cell(2, "runtime_ms"), "20.0000");
        assert_eq!(cell(2, "particles"), "2");
        assert_eq!(cell(2, "mcl_sigma_long_m"), "2.0000");
        assert_eq!(cell(2, "mcl_sigma_short_m"), "0.1000");
        // Along y of the map, of a car that heads 0.1 rad to the left of x.
        assert_eq!(cell(2, "mcl_long_axis_from_forward_deg"), "84.2704");
        assert_eq!(cell(2, "time_s"), "");
        assert_eq!(cell(2, "refined_x_m"), "");
    }
}
