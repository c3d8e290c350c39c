//! Pages in a real browser: displayed on a desktop and on a phone, printed, sorted by clicks.
//!
//! `FPMCL_PAGES` lists pages, separated by colons; `FPMCL_SCREENSHOTS` is the folder of the
//! screenshots. `.ci/run` sets both. Without them, or without Chromium, the tests are skipped with
//! a message.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

#[path = "../src/skips_for_tests.rs"]
mod skips;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use fpmcl::internals::app::Bitmap;
use skips::skipped;

/// Widths of the windows of a desktop and of a phone [px].
const WIDTHS: [u32; 2] = [1400, 390];

/// Minimum width of a window of the browser [px].
const MIN_WIDTH: u32 = 500;

/// Maximum height of a window that the browser paints [px].
const MAX_HEIGHT: u32 = 8000;

/// Time limit of the browser, which takes seconds.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Chromium with the pages under test.
struct Browser {
    program: &'static str,
    pages: Vec<PathBuf>,
    screenshots: PathBuf,
}

impl Browser {
    /// `None`, with a message, without pages or without a browser.
    #[track_caller]
    fn open() -> Option<Self> {
        let (Ok(pages), Ok(screenshots)) = (
            std::env::var("FPMCL_PAGES"),
            std::env::var("FPMCL_SCREENSHOTS"),
        ) else {
            skipped("FPMCL_PAGES and FPMCL_SCREENSHOTS are not set");
            return None;
        };
        let programs = ["chromium", "chromium-browser", "google-chrome"];
        let is_installed = |program: &&str| {
            let mut command = Command::new(program);
            command
                .arg("--version")
                .stdout(Stdio::null())
                .stderr(Stdio::null());
            finished_within(TIMEOUT, &mut command).is_ok_and(|status| status.success())
        };
        let Some(program) = programs.into_iter().find(is_installed) else {
            skipped("there is no Chromium");
            return None;
        };
        fs::create_dir_all(&screenshots).unwrap();
        Some(Self {
            program,
            pages: pages.split(':').map(PathBuf::from).collect(),
            screenshots: fs::canonicalize(screenshots).unwrap(),
        })
    }

    /// Standard output of the browser for an address.
    fn visit(&self, address: &str, arguments: &[String]) -> String {
        let profile = tempfile::tempdir().unwrap();
        let output = profile.path().join("output.txt");
        let errors = profile.path().join("errors.txt");
        let mut visiting = Command::new(self.program);
        visiting
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--no-first-run",
            ])
            .args(["--disable-quic", "--disable-background-networking"])
            .args([
                "--disable-component-update",
                "--disable-sync",
                "--hide-scrollbars",
            ])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .args(arguments)
            .arg(address)
            .stdout(fs::File::create(&output).unwrap())
            .stderr(fs::File::create(&errors).unwrap());
        let finished = finished_within(TIMEOUT, &mut visiting);
        let read = |path| String::from_utf8_lossy(&fs::read(path).unwrap()).into_owned();
        let succeeded = finished.as_ref().is_ok_and(ExitStatus::success);
        assert!(succeeded, "{address}: {finished:?}: {}", read(&errors));
        read(&output)
    }

    /// Report of a script about a page in a window of a width.
    fn run_script(&self, html: &str, fragment: &str, script: &str, width: u32) -> String {
        let report = "const report = (text) => parent.postMessage(text, '*');";
        let added = format!("<script>\n{report}\n{script}\n</script>\n</body>");
        let window = Window::of(&html.replace("</body>", &added), fragment, [width, 900]);
        // Enough time for the message to arrive [ms].
        let arguments = ["--dump-dom", "--virtual-time-budget=10000"].map(str::to_owned);
        let found = self.visit(&window.address, &arguments);
        let (_, rest) = found.rsplit_once("<output>").unwrap();
        rest.split_once("</output>").unwrap().0.to_owned()
    }

    /// The whole page in one picture.
    fn screenshot(&self, html: &str, width: u32, height: u32) -> Bitmap {
        let mut pixels = Vec::new();
        for top in (0..height).step_by(MAX_HEIGHT as usize) {
            let style = format!("<style>body {{ margin-top: -{top}px }}</style></head>");
            let rows = MAX_HEIGHT.min(height - top);
            let window = Window::of(&html.replace("</head>", &style), "", [width, rows]);
            let picture = window.folder.path().join("part.png");
            let size = format!("--window-size={},{rows}", width.max(MIN_WIDTH));
            let shot = format!("--screenshot={}", picture.display());
            self.visit(&window.address, &[shot, size]);
            let part = Bitmap::read_png(&picture).unwrap();
            for row in part.pixels.chunks(part.width as usize).take(rows as usize) {
                pixels.extend(&row[..width as usize]);
            }
        }
        Bitmap {
            width,
            height,
            pixels,
        }
    }
}

/// Exit status of a program; one that takes longer than the limit is killed, which is an error.
fn finished_within(limit: Duration, command: &mut Command) -> Result<ExitStatus, String> {
    let child = command.spawn();
    let failed = |error: std::io::Error| format!("{command:?}: {error}");
    let mut child = child.map_err(failed)?;
    let started = Instant::now();
    loop {
        if let Some(status) = child.try_wait().map_err(failed)? {
            return Ok(status);
        }
        if started.elapsed() > limit {
            child.kill().and_then(|()| child.wait()).map_err(failed)?;
            return Err(format!("{command:?} hung and was killed after {limit:?}"));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[cfg(unix)]
#[test]
fn a_program_that_hangs_is_killed_with_an_error() {
    let mut hanging = Command::new("sleep");
    let error = finished_within(Duration::from_millis(50), hanging.arg("3600")).unwrap_err();
    assert!(error.contains("sleep") && error.contains("hung"), "{error}");
    let status = finished_within(TIMEOUT, &mut Command::new("true")).unwrap();
    assert!(status.success());
}

/// A page in a frame, which may be narrower than the windows of the browser.
struct Window {
    folder: tempfile::TempDir,
    address: String,
}

impl Window {
    fn of(html: &str, fragment: &str, [width, height]: [u32; 2]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("page.html"), html).unwrap();
        let frame = format!(
            "<!doctype html>\n<body style=\"margin: 0\">\n\
             <script>\naddEventListener('message', (event) => {{\n  \
             const place = document.createElement('output');\n  \
             place.textContent = event.data;\n  document.body.append(place);\n}});\n</script>\n\
             <iframe src=\"page.html{fragment}\" width=\"{width}\" height=\"{height}\" \
             style=\"border: 0; display: block\"></iframe>\n</body>\n"
        );
        let path = folder.path().join("window.html");
        fs::write(&path, frame).unwrap();
        Self {
            address: format!("file://{}", path.display()),
            folder,
        }
    }
}

/// Name of the screenshots of a page: its last two folders.
fn name_of(page: &Path) -> String {
    let folder = fs::canonicalize(page).unwrap();
    let parts: Vec<_> = folder.parent().unwrap().iter().rev().take(2).collect();
    let parts = parts.iter().rev().map(|part| part.to_string_lossy());
    parts.collect::<Vec<_>>().join("_")
}

#[test]
fn pages_fit_a_desktop_and_a_phone() {
    let Some(browser) = Browser::open() else {
        return;
    };
    for page in &browser.pages {
        let html = fs::read_to_string(page).unwrap();
        for width in WIDTHS {
            let report = browser.run_script(&html, "", include_str!("browser/size.js"), width);
            let place = format!("{}, {width} pixels wide: {report}", page.display());
            let [seen, height, fits] = report.splitn(3, ' ').collect::<Vec<_>>()[..] else {
                panic!("{place}")
            };
            assert_eq!(
                (seen, fits),
                (width.to_string().as_str(), "fits"),
                "{place}"
            );
            let pixels = browser.screenshot(&html, width, height.parse().unwrap());
            let name = format!("{}_{width}.png", name_of(page));
            let file = fs::File::create(browser.screenshots.join(&name)).unwrap();
            pixels.write_png(file).unwrap();
            if let Some(defect) = defect_of_page(&pixels) {
                panic!("{place}: {defect}");
            }
        }
    }
}

#[test]
fn pages_are_printed() {
    let Some(browser) = Browser::open() else {
        return;
    };
    for page in &browser.pages {
        let pdf = browser.screenshots.join(format!("{}.pdf", name_of(page)));
        let address = format!("file://{}", fs::canonicalize(page).unwrap().display());
        let print = format!("--print-to-pdf={}", pdf.display());
        browser.visit(&address, &["--no-pdf-header-footer".to_owned(), print]);
        let bytes = fs::read(&pdf).unwrap();
        assert!(bytes.starts_with(b"%PDF"), "{}", pdf.display());
        let sheets = bytes
            .windows(12)
            .filter(|word| word == b"/Type /Page\n")
            .count();
        assert!(sheets > 1, "{} has {sheets} sheets", pdf.display());
    }
}

#[test]
fn a_click_on_any_column_title_sorts_and_a_link_leads_to_the_sorted_table() {
    let Some(browser) = Browser::open() else {
        return;
    };
    let script = include_str!("browser/sorting.js");
    for page in &browser.pages {
        let html = fs::read_to_string(page).unwrap();
        for width in WIDTHS {
            let report = browser.run_script(&html, "", script, width);
            assert!(
                report.ends_with("titles; all sort"),
                "{}: {report}",
                page.display()
            );
        }
        // A page whose clicks have no effect is detected.
        let dead = html.replace("addEventListener(\"click\"", "addEventListener(\"never\"");
        let report = browser.run_script(&dead, "", script, WIDTHS[0]);
        assert!(
            report.contains("not marked"),
            "{}: {report}",
            page.display()
        );

        let (_, rest) = html.split_once("<table id=\"").unwrap();
        let (table, _) = rest.split_once('"').unwrap();
        let first = "report([...document.querySelectorAll('th[aria-sort]')].map((head) => \
                     `${head.closest('table').id} ${head.cellIndex} ${head.ariaSort}`).join());";
        let report = browser.run_script(&html, &format!("#sort={table}/-2"), first, WIDTHS[0]);
        assert_eq!(report, format!("{table} 1 descending"));
    }
}

/// Minimum number of colors of a page with text, lines and charts.
const MIN_COLORS: usize = 50;

/// Number of rows at the top, with a heading, and at the end, which are not blank [px].
const ENDS: u32 = 300;

/// Defect of the screenshot of a page.
fn defect_of_page(pixels: &Bitmap) -> Option<String> {
    let colors: BTreeSet<[u8; 3]> = pixels.pixels.iter().copied().collect();
    if colors.len() < MIN_COLORS {
        return Some(format!("only {} colors", colors.len()));
    }
    let band = |from: u32, to: u32| {
        let [from, to] = [from, to].map(|row| (row * pixels.width) as usize);
        let rows = pixels.pixels[from..to].iter();
        rows.filter(|pixel| **pixel != [255; 3]).count()
    };
    let height = pixels.height;
    let top = band(0, ENDS.min(height));
    let middle = band(ENDS.min(height), height);
    let end = band(height.saturating_sub(ENDS), height);
    (top < 500 || middle < 5000 || end < 200)
        .then(|| format!("{top} pixels of heading, {middle} below, {end} at the end"))
}

#[test]
fn a_blank_page_and_one_that_ends_early_are_detected() {
    let mut pixels = Bitmap::from_fn(400, 900, |_, _| [255; 3]);
    assert_eq!(defect_of_page(&pixels).unwrap(), "only 1 colors");
    let mut paint = |rows: std::ops::Range<usize>| {
        for y in rows {
            for x in 0..200 {
                pixels.pixels[y * 400 + x] = [x as u8, 0, 0];
            }
        }
        defect_of_page(&pixels)
    };
    let heading = "10000 pixels of heading, 0 below, 0 at the end";
    assert_eq!(paint(10..60).unwrap(), heading);
    let early = "10000 pixels of heading, 20000 below, 0 at the end";
    assert_eq!(paint(400..500).unwrap(), early);
    assert_eq!(paint(800..810), None);
}
