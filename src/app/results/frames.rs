//! `frames.csv`: one tidy row per frame, units in the header, empty where nothing is known.

use std::io::{self, Write};
use std::path::Path;

use super::localization_results::{LocalizationResults, ResultsError};
use crate::app::output::write_atomically;
use crate::evaluation::{PlanarError, distances_m};
use crate::geometry::Pose2;

/// One column: its title and what stands in a row.
struct Column<'a> {
    title: String,
    cell: Box<dyn Fn(usize) -> Option<String> + 'a>,
}

/// Writes the table; `estimates` are those of the filter, one per frame.
pub fn write_frames_csv(
    path: &Path,
    results: &LocalizationResults,
    estimates: &[Pose2],
) -> Result<(), ResultsError> {
    if estimates.len() != results.len() {
        return Err(ResultsError::WrongLength {
            path: path.to_owned(),
            array: "estimates",
            found: estimates.len(),
            expected: results.len(),
        });
    }
    let columns = columns(results, estimates);
    write_atomically(path, |file| write_rows(file, &columns, results.len())).map_err(|source| {
        ResultsError::Write {
            path: path.to_owned(),
            source,
        }
    })
}

fn columns<'a>(results: &'a LocalizationResults, estimates: &'a [Pose2]) -> Vec<Column<'a>> {
    let truth = results.ground_truth.as_deref();
    let driven_m = distances_m(truth.unwrap_or(estimates));
    let mut columns = vec![
        column("frame", |row| Some(results.frames[row].to_string())),
        number("time_s", results.times_s.as_deref(), 1.0),
        column("distance_m", move |row| {
            Some(format!("{:.4}", driven_m[row]))
        }),
    ];
    columns.extend(pose_columns("truth", truth));
    columns.extend(pose_columns("mcl", Some(estimates)));
    columns.extend(error_columns("mcl", Some(estimates), truth));
    columns.extend(pose_columns("refined", results.refined.as_deref()));
    columns.extend(error_columns("refined", results.refined.as_deref(), truth));
    columns.extend([
        column("particles", |row| {
            (!results.particles.is_empty()).then(|| results.particles.frame(row).len().to_string())
        }),
        column("state", |row| {
            Some(results.states.as_ref()?[row].to_string())
        }),
        number("runtime_ms", results.runtimes_s.as_deref(), 1e3),
        number(
            "refine_runtime_ms",
            results.refine_runtimes_s.as_deref(),
            1e3,
        ),
    ]);
    columns
}

fn column<'a>(title: &str, cell: impl Fn(usize) -> Option<String> + 'a) -> Column<'a> {
    Column {
        title: title.to_owned(),
        cell: Box::new(cell),
    }
}

fn number<'a>(title: &str, numbers: Option<&'a [f64]>, scale: f64) -> Column<'a> {
    column(title, move |row| {
        Some(format!("{:.4}", scale * numbers?[row]))
    })
}

fn pose_columns<'a>(name: &str, poses: Option<&'a [Pose2]>) -> [Column<'a>; 3] {
    let of = |title: &str, part: fn(&Pose2) -> f64| {
        column(&format!("{name}_{title}"), move |row| {
            Some(format!("{:.4}", part(&poses?[row])))
        })
    };
    [
        of("x_m", |pose| pose.translation.x),
        of("y_m", |pose| pose.translation.y),
        of("heading_deg", |pose| pose.rotation.angle().to_degrees()),
    ]
}

fn error_columns<'a>(
    name: &str,
    estimates: Option<&'a [Pose2]>,
    truth: Option<&'a [Pose2]>,
) -> [Column<'a>; 4] {
    let of = |title: &str, part: fn(&PlanarError) -> f64| {
        column(&format!("{name}_{title}"), move |row| {
            let error = PlanarError::between(&estimates?[row], &truth?[row]);
            Some(format!("{:.4}", part(&error)))
        })
    };
    [
        of("position_error_m", PlanarError::distance_m),
        of("along_error_m", |error| error.along_m),
        of("across_error_m", |error| error.across_m),
        of("heading_error_deg", |error| error.turn_rad.to_degrees()),
    ]
}

fn write_rows(file: &mut impl Write, columns: &[Column], rows: usize) -> io::Result<()> {
    let titles: Vec<&str> = columns.iter().map(|column| column.title.as_str()).collect();
    writeln!(file, "{}", titles.join(","))?;
    for row in 0..rows {
        let cells: Vec<String> = columns
            .iter()
            .map(|column| (column.cell)(row).unwrap_or_default())
            .collect();
        writeln!(file, "{}", cells.join(","))?;
    }
    Ok(())
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
        let mut particles = ParticleLog::new(10);
        (0..3).for_each(|_| particles.push_frame([[1.0; 4]; 2]));
        let results = LocalizationResults {
            frames: vec![1, 3, 5],
            particles,
            ground_truth: Some(truth),
            runtimes_s: Some(vec![0.01, 0.02, 0.03]),
            ..LocalizationResults::default()
        };
        write_frames_csv(&path, &results, &estimates).unwrap();
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
        assert_eq!(cell(2, "time_s"), "");
        assert_eq!(cell(2, "refined_x_m"), "");
    }
}
