//! The pictures of runs made outside of this test: each is readable, and shows what it should.
//!
//! `FPMCL_RUNS` names the folders of runs (of `demo`, or of `localize` and `refine`), separated
//! by colons. `.ci/run` sets it after it has made them.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::path::Path;

use common::picture::Picture;
use fpmcl::app::plotting::color::{MCL, REFINED};

#[test]
fn the_pictures_of_finished_runs_show_the_paths() {
    let Ok(runs) = std::env::var("FPMCL_RUNS") else {
        eprintln!("not run: FPMCL_RUNS names no runs");
        return;
    };
    for run in runs.split(':') {
        // Tests run in the folder of the package, as .ci/run does.
        let plots = Path::new(run).join("plots");
        let picture = |name: &str| Picture::read(&plots.join(name));
        // The last path that is drawn may lie on all the others.
        picture("path.png").shows(&[REFINED]);
        picture("errors.png").shows_at_least(400, &[MCL, REFINED]);
        picture("runtime.png").shows(&[MCL, REFINED]);
        picture("particles.png").shows(&[MCL]);
        picture("map.png").shows(&[]);
    }
}

#[test]
fn a_blank_or_a_small_picture_or_one_without_the_line_is_none() {
    let line = [213, 94, 0];
    let mut pixels = image::RgbImage::from_pixel(1300, 400, image::Rgb([255; 3]));
    let objection = |pixels: &image::RgbImage| {
        let picture = Picture::of("own".to_owned(), pixels);
        picture.objection(40, &[line]).unwrap_or_default()
    };
    assert_eq!(objection(&pixels), "blank");
    for x in 0..1300 {
        // The legend is no line.
        pixels.put_pixel(x, 60, image::Rgb(line));
        for y in 0..20 {
            pixels.put_pixel(x, 150 + y, image::Rgb([x as u8, 40, y as u8]));
        }
    }
    assert!(objection(&pixels).starts_with("nothing is drawn in"));
    for x in 0..60 {
        pixels.put_pixel(x, 200, image::Rgb(line));
    }
    assert_eq!(objection(&pixels), "");
    let small = image::imageops::crop_imm(&pixels, 0, 0, 800, 400).to_image();
    assert!(objection(&small).starts_with("only 800"));
}
