//! The last program of `cargo test`, by its name: lists the tests that were skipped.

#![allow(clippy::print_stdout, reason = "the list")]

#[allow(dead_code, reason = "no test is skipped here")]
#[path = "../src/skips_for_tests.rs"]
mod skips;

fn main() {
    if std::env::args().any(|argument| argument == "--list") {
        return;
    }
    let text = skips::of_this_call();
    let mut lines: Vec<&str> = text.lines().collect();
    lines.sort_unstable();
    lines.dedup();
    if lines.is_empty() {
        println!("\nno test was skipped\n");
        return;
    }
    println!("\n{} tests were skipped:", lines.len());
    lines.iter().for_each(|line| println!("  {line}"));
    println!();
}
