//! Pages in a real browser: seen whole on a desk and on a phone, printed, sorted by clicks.
//!
//! `FPMCL_PAGES` names pages, separated by colons; `FPMCL_SCREENSHOTS` is the folder in which is kept
//! what the browser shows. `.ci/run` sets both. Without them, or without Chromium, nothing is tried,
//! and that is said.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]
#![allow(clippy::print_stderr, reason = "what is not tried is said")]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use fpmcl::app::plotting::Bitmap;

/// Widths of a desk's and a phone's window [pixels].
const WIDTHS: [u32; 2] = [1280, 390];

/// The browser makes no window narrower than this [pixels].
const NARROWEST: u32 = 500;

/// The browser does not paint a window that is higher [pixels].
const HIGHEST: u32 = 8000;

/// After this the browser hangs; it takes seconds.
const PATIENCE: Duration = Duration::from_secs(120);

/// Chromium with pages to look at.
struct Browser {
    program: &'static str,
    pages: Vec<PathBuf>,
    kept: PathBuf,
}

impl Browser {
    /// `None`, with a word, where there is nothing to look at or nothing to look with.
    fn open() -> Option<Self> {
        let (Ok(pages), Ok(kept)) = (
            std::env::var("FPMCL_PAGES"),
            std::env::var("FPMCL_SCREENSHOTS"),
        ) else {
            eprintln!("not run: FPMCL_PAGES and FPMCL_SCREENSHOTS name no pages and no folder");
            return None;
        };
        let programs = ["chromium", "chromium-browser", "google-chrome"];
        let is_there = |program: &&str| {
            let mut asked = Command::new(program);
            asked
                .arg("--version")
                .stdout(Stdio::null())
                .stderr(Stdio::null());
            finished_within(PATIENCE, &mut asked).is_ok_and(|status| status.success())
        };
        let Some(program) = programs.into_iter().find(is_there) else {
            eprintln!("not run: there is no Chromium");
            return None;
        };
        fs::create_dir_all(&kept).unwrap();
        Some(Self {
            program,
            pages: pages.split(':').map(PathBuf::from).collect(),
            kept: fs::canonicalize(kept).unwrap(),
        })
    }

    /// What the browser writes to standard output about an address.
    fn visit(&self, address: &str, arguments: &[String]) -> String {
        let profile = tempfile::tempdir().unwrap();
        let said = profile.path().join("said.txt");
        let complained = profile.path().join("complained.txt");
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
            .stdout(fs::File::create(&said).unwrap())
            .stderr(fs::File::create(&complained).unwrap());
        let finished = finished_within(PATIENCE, &mut visiting);
        let read = |path| String::from_utf8_lossy(&fs::read(path).unwrap()).into_owned();
        let is_well = finished.as_ref().is_ok_and(ExitStatus::success);
        assert!(is_well, "{address}: {finished:?}: {}", read(&complained));
        read(&said)
    }

    /// What a script says of a page in a window of some width.
    fn ask(&self, html: &str, fragment: &str, script: &str, width: u32) -> String {
        let say = "const said = (text) => parent.postMessage(text, '*');";
        let added = format!("<script>\n{say}\n{script}\n</script>\n</body>");
        let window = Window::of(&html.replace("</body>", &added), fragment, [width, 900]);
        // Enough for a message to arrive [ms].
        let arguments = ["--dump-dom", "--virtual-time-budget=10000"].map(str::to_owned);
        let found = self.visit(&window.address, &arguments);
        let (_, rest) = found.rsplit_once("<output>").unwrap();
        rest.split_once("</output>").unwrap().0.to_owned()
    }

    /// The page from its top to its end, in one picture.
    fn screenshot(&self, html: &str, width: u32, height: u32) -> Bitmap {
        let mut pixels = Vec::new();
        for top in (0..height).step_by(HIGHEST as usize) {
            let style = format!("<style>body {{ margin-top: -{top}px }}</style></head>");
            let rows = HIGHEST.min(height - top);
            let window = Window::of(&html.replace("</head>", &style), "", [width, rows]);
            let picture = window.folder.path().join("part.png");
            let size = format!("--window-size={},{rows}", width.max(NARROWEST));
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

/// How a program ended; one that takes longer is killed, and that is told.
fn finished_within(limit: Duration, command: &mut Command) -> Result<ExitStatus, String> {
    let child = command.spawn();
    let told = |error: std::io::Error| format!("{command:?}: {error}");
    let mut child = child.map_err(told)?;
    let started = Instant::now();
    loop {
        if let Some(status) = child.try_wait().map_err(told)? {
            return Ok(status);
        }
        if started.elapsed() > limit {
            child.kill().and_then(|()| child.wait()).map_err(told)?;
            return Err(format!("{command:?} hung and was killed after {limit:?}"));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[cfg(unix)]
#[test]
fn a_program_that_hangs_is_killed_and_told() {
    let mut hanging = Command::new("sleep");
    let told = finished_within(Duration::from_millis(50), hanging.arg("3600")).unwrap_err();
    assert!(told.contains("sleep") && told.contains("hung"), "{told}");
    let status = finished_within(PATIENCE, &mut Command::new("true")).unwrap();
    assert!(status.success());
}

/// A page in a frame of its own, which may be narrower than the browser's windows.
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
             <script>\naddEventListener('message', (told) => {{\n  \
             const place = document.createElement('output');\n  \
             place.textContent = told.data;\n  document.body.append(place);\n}});\n</script>\n\
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

/// A name for what is kept of a page: the last folders that it lies in.
fn name_of(page: &Path) -> String {
    let folder = fs::canonicalize(page).unwrap();
    let parts: Vec<_> = folder.parent().unwrap().iter().rev().take(2).collect();
    let parts = parts.iter().rev().map(|part| part.to_string_lossy());
    parts.collect::<Vec<_>>().join("_")
}

#[test]
fn pages_are_seen_whole_on_a_desk_and_on_a_phone() {
    let Some(browser) = Browser::open() else {
        return;
    };
    for page in &browser.pages {
        let html = fs::read_to_string(page).unwrap();
        for width in WIDTHS {
            let said = browser.ask(&html, "", include_str!("browser/seen.js"), width);
            let place = format!("{}, {width} pixels wide: {said}", page.display());
            let [seen, height, fits] = said.splitn(3, ' ').collect::<Vec<_>>()[..] else {
                panic!("{place}")
            };
            assert_eq!(
                (seen, fits),
                (width.to_string().as_str(), "fits"),
                "{place}"
            );
            let pixels = browser.screenshot(&html, width, height.parse().unwrap());
            let name = format!("{}_{width}.png", name_of(page));
            let kept = fs::File::create(browser.kept.join(&name)).unwrap();
            pixels.write_png(kept).unwrap();
            if let Some(objection) = objection_to_page(&pixels) {
                panic!("{place}: {objection}");
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
        let pdf = browser.kept.join(format!("{}.pdf", name_of(page)));
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
fn a_click_on_any_head_sorts_and_a_link_leads_to_the_table_as_it_was_sorted() {
    let Some(browser) = Browser::open() else {
        return;
    };
    let script = include_str!("browser/sorted.js");
    for page in &browser.pages {
        let html = fs::read_to_string(page).unwrap();
        for width in WIDTHS {
            let said = browser.ask(&html, "", script, width);
            assert!(
                said.ends_with("heads; all sort"),
                "{}: {said}",
                page.display()
            );
        }
        // A page that has forgotten how is found out.
        let dead = html.replace("addEventListener(\"click\"", "addEventListener(\"never\"");
        let said = browser.ask(&dead, "", script, WIDTHS[0]);
        assert!(said.contains("not told"), "{}: {said}", page.display());

        let (_, rest) = html.split_once("<table id=\"").unwrap();
        let (table, _) = rest.split_once('"').unwrap();
        let first = "said([...document.querySelectorAll('th[aria-sort]')].map((head) => \
                     `${head.closest('table').id} ${head.cellIndex} ${head.ariaSort}`).join());";
        let said = browser.ask(&html, &format!("#sort={table}/-2"), first, WIDTHS[0]);
        assert_eq!(said, format!("{table} 1 descending"));
    }
}

/// A page with text, lines and charts has far more than this many colours.
const LEAST_COLORS: usize = 50;

/// Rows at the top that have a heading, and rows at the end that have something, whatever the page
/// [pixels].
const ENDS: u32 = 300;

/// What speaks against a page as a browser showed it.
fn objection_to_page(pixels: &Bitmap) -> Option<String> {
    let colors: BTreeSet<[u8; 3]> = pixels.pixels.iter().copied().collect();
    if colors.len() < LEAST_COLORS {
        return Some(format!("only {} colours", colors.len()));
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
fn a_blank_page_and_one_that_ends_early_are_none() {
    let mut pixels = Bitmap::from_fn(400, 900, |_, _| [255; 3]);
    assert_eq!(objection_to_page(&pixels).unwrap(), "only 1 colours");
    let mut paint = |rows: std::ops::Range<usize>| {
        for y in rows {
            for x in 0..200 {
                pixels.pixels[y * 400 + x] = [x as u8, 0, 0];
            }
        }
        objection_to_page(&pixels)
    };
    let heading = "10000 pixels of heading, 0 below, 0 at the end";
    assert_eq!(paint(10..60).unwrap(), heading);
    let early = "10000 pixels of heading, 20000 below, 0 at the end";
    assert_eq!(paint(400..500).unwrap(), early);
    assert_eq!(paint(800..810), None);
}
