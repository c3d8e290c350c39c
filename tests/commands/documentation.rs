//! The pages of the documentation: the files and headings that their links and includes name exist, and the book
//! contains every page of `docs`.

use std::fs;
use std::path::{Path, PathBuf};

/// Paths of the pages below the repository, in its root, `data` and `docs`.
fn pages() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folders = [root.to_owned(), root.join("data"), root.join("docs")];
    let files = folders.iter().flat_map(|it| fs::read_dir(it).unwrap());
    let mut pages: Vec<PathBuf> = files.map(|file| file.unwrap().path()).collect();
    pages.retain(|path| path.extension().is_some_and(|it| it == "md"));
    pages.sort();
    pages
}

/// The lines of a page outside its blocks of code.
fn prose(text: &str) -> impl Iterator<Item = &str> {
    let mut is_code = false;
    text.lines().filter(move |line| {
        let is_fence = line.trim_start().starts_with("```");
        is_code ^= is_fence;
        !is_code && !is_fence
    })
}

/// What stands between `start` and `end` in a line.
fn between<'a>(line: &'a str, start: &'a str, end: char) -> impl Iterator<Item = &'a str> {
    line.split(start)
        .skip(1)
        .filter_map(move |rest| Some(rest.split_once(end)?.0))
}

/// The anchors of the headings of a page, as mdBook and the forges make them.
fn anchors(text: &str) -> Vec<String> {
    let headings = prose(text).filter(|line| line.starts_with('#'));
    let anchor = |heading: &str| -> String {
        let title = heading.trim_start_matches('#').trim().to_lowercase();
        let kept = title
            .chars()
            .filter(|&c| c.is_alphanumeric() || " -_".contains(c));
        kept.map(|c| if c == ' ' { '-' } else { c }).collect()
    };
    headings.map(anchor).collect()
}

/// What is wrong with a link of a page.
fn problem(page: &Path, link: &str) -> Option<&'static str> {
    let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
    let path = match file {
        "" => page.to_owned(),
        _ => page.parent()?.join(file),
    };
    let is_in_book = page.parent()?.ends_with("docs");
    if is_in_book && file.starts_with("..") {
        return Some("is not in the book");
    }
    if !path.exists() {
        return Some("does not exist");
    }
    let has_anchor = || anchors(&fs::read_to_string(&path).unwrap()).contains(&anchor.to_owned());
    (!anchor.is_empty() && !has_anchor()).then_some("has no such heading")
}

#[test]
fn links_and_includes_lead_to_files_and_headings_that_exist() {
    let mut wrong = Vec::new();
    for page in pages() {
        let text = fs::read_to_string(&page).unwrap();
        let links = prose(&text).flat_map(|line| between(line, "](", ')'));
        let links = links.filter(|link| !link.starts_with("http"));
        let problems = links.filter_map(|link| Some((link, problem(&page, link)?)));
        let includes = text
            .lines()
            .flat_map(|line| between(line, "{{#include ", '}'));
        let missing = includes.filter(|file| !page.parent().unwrap().join(file).exists());
        let problems = problems.chain(missing.map(|file| (file, "does not exist")));
        wrong.extend(
            problems.map(|(link, problem)| format!("{}: {link} {problem}", page.display())),
        );
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn the_book_contains_every_page_of_docs() {
    let summary = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/SUMMARY.md");
    let contents = fs::read_to_string(&summary).unwrap();
    for page in pages() {
        let name = page.file_name().unwrap().to_str().unwrap();
        let is_listed = page == summary || contents.contains(&format!("]({name})"));
        let is_page = page.parent() == summary.parent();
        assert!(
            is_listed || !is_page,
            "docs/{name} is not in docs/SUMMARY.md"
        );
    }
}

#[test]
fn a_link_to_nothing_is_reported() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/SUMMARY.md");
    assert_eq!(problem(&page, "start.md"), None);
    assert_eq!(problem(&page, "start.md#install"), None);
    assert_eq!(
        problem(&page, "start.md#nothing"),
        Some("has no such heading")
    );
    assert_eq!(problem(&page, "nothing.md"), Some("does not exist"));
    assert_eq!(problem(&page, "../README.md"), Some("is not in the book"));
}
