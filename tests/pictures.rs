//! Pictures of earlier runs: each is readable and has the expected content.
//!
//! `FPMCL_RUNS` lists the folders of runs (of `demo`, or of `localize` and `refine`), separated
//! by colons; `.ci/run` sets it.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::path::Path;

use common::picture::Picture;
use fpmcl::internals::app::Bitmap;
use fpmcl::internals::app::color::{MCL, REFINED};

#[test]
fn the_pictures_of_finished_runs_show_the_paths() {
    let Ok(runs) = std::env::var("FPMCL_RUNS") else {
        common::skips::skipped("FPMCL_RUNS is not set");
        return;
    };
    for run in runs.split(':') {
        // Relative to the folder of the package.
        let plots = Path::new(run).join("plots");
        let picture = |name: &str| Picture::read(&plots.join(name));
        // The refined path has the colors of its errors.
        picture("path.png").shows(&[MCL]);
        picture("errors.png").shows_at_least(400, &[MCL, REFINED]);
        picture("runtime.png").shows(&[MCL, REFINED]);
        picture("particles.png").shows(&[MCL]);
        picture("map.png").shows(&[]);
    }
}

#[test]
fn a_blank_or_small_picture_or_one_without_the_line_is_detected() {
    let line = [213, 94, 0];
    let mut pixels = Bitmap::from_fn(1300, 400, |_, _| [255; 3]);
    let defect = |pixels: &Bitmap| {
        let picture = Picture::of("own".to_owned(), pixels);
        picture.defect(40, &[line]).unwrap_or_default()
    };
    assert_eq!(defect(&pixels), "blank");
    pixels = Bitmap::from_fn(1300, 400, |x, y| match y {
        // The legend has the color of the line.
        60 => line,
        150..170 => [x as u8, 40, (y - 150) as u8],
        _ => [255; 3],
    });
    assert!(defect(&pixels).starts_with("nothing is drawn in"));
    pixels.pixels[200 * 1300..][..60].fill(line);
    assert_eq!(defect(&pixels), "");
    let small = Bitmap::from_fn(800, 400, |x, y| pixels.pixel(x, y));
    assert!(defect(&small).starts_with("only 800"));
}
