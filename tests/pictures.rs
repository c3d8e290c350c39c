//! The pictures of runs made outside of this test: each is readable, and shows what it should.
//!
//! `FPMCL_RUNS` names the folders of runs (of `demo`, or of `localize` and `refine`), separated
//! by colons; `FPMCL_SCREENSHOTS` names pages as a browser showed them. `.ci/run` sets both after it
//! has made them.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::collections::BTreeSet;
use std::path::Path;

use common::picture::Picture;
use fpmcl::plotting::color::{MCL, REFINED, TRUTH};

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
        picture("path.png").shows(&[TRUTH, MCL, REFINED]);
        picture("errors.png").shows_at_least(400, &[MCL, REFINED]);
        picture("runtime.png").shows(&[MCL, REFINED]);
        picture("particles.png").shows(&[MCL]);
        picture("map.png").shows(&[]);
    }
}

/// A page with text, lines and charts has far more than this many colours.
const LEAST_COLORS: usize = 50;

/// Rows at the top that have a heading, whatever the page [pixels].
const TOP: u32 = 300;

/// What speaks against a page as a browser showed it.
fn objection_to_page(pixels: &image::RgbImage) -> Option<String> {
    let colors: BTreeSet<[u8; 3]> = pixels.pixels().map(|pixel| pixel.0).collect();
    if colors.len() < LEAST_COLORS {
        return Some(format!("only {} colours", colors.len()));
    }
    let band = |from: u32, to: u32| {
        let (width, height) = pixels.dimensions();
        let rows = from.min(height)..to.min(height);
        let places = rows.flat_map(|y| (0..width).map(move |x| (x, y)));
        places
            .filter(|&(x, y)| pixels.get_pixel(x, y).0 != [255; 3])
            .count()
    };
    let [top, below] = [band(0, TOP), band(TOP, u32::MAX)];
    (top < 500 || below < 5000).then(|| format!("{top} pixels of heading, {below} below"))
}

#[test]
fn pages_are_not_blank_in_a_browser() {
    let Some(pages) = std::env::var("FPMCL_SCREENSHOTS")
        .ok()
        .filter(|pages| !pages.is_empty())
    else {
        eprintln!("not run: FPMCL_SCREENSHOTS names no screenshots");
        return;
    };
    for page in pages.split(':') {
        let pixels = image::open(page).unwrap().to_rgb8();
        if let Some(objection) = objection_to_page(&pixels) {
            panic!("{page}: {objection}");
        }
    }
}

#[test]
fn a_blank_page_and_one_with_a_heading_alone_are_none() {
    let mut pixels = image::RgbImage::from_pixel(400, 900, image::Rgb([255; 3]));
    assert_eq!(objection_to_page(&pixels).unwrap(), "only 1 colours");
    let mut paint = |rows: std::ops::Range<u32>| {
        for y in rows {
            for x in 0..200 {
                pixels.put_pixel(x, y, image::Rgb([x as u8, 0, 0]));
            }
        }
        objection_to_page(&pixels)
    };
    assert_eq!(paint(10..60).unwrap(), "10000 pixels of heading, 0 below");
    assert_eq!(paint(400..500), None);
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
