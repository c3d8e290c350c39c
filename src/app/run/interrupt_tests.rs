//! A signal is seen, and work that ends in time is not interrupted.

use std::process::Command;
use std::time::Instant;

use super::*;

#[test]
fn a_signal_is_seen_by_every_copy() {
    let interrupt = Interrupt::install().unwrap();
    // The process of the tests must not end.
    std::mem::forget(interrupt.saving());
    let copy = interrupt.clone();
    assert!(!copy.requested());
    let pid = std::process::id().to_string();
    // Shells have what runs in the background ignore SIGINT.
    let sent = Command::new("kill").args(["-TERM", &pid]).status().unwrap();
    assert!(sent.success());
    let start = Instant::now();
    while !copy.requested() && start.elapsed() < Duration::from_secs(20) {
        thread::sleep(Duration::from_millis(5));
    }
    assert!(copy.requested() && interrupt.requested());
}

#[test]
fn supervised_work_returns_its_value_and_nothing_is_saved() {
    let interrupt = Interrupt::default();
    interrupt.request();
    let value = interrupt.supervise(|| 7, || unreachable!("the work is in time"));
    assert_eq!(value, 7);
}

#[test]
fn a_request_that_was_the_end_of_a_drive_hurries_nothing() {
    let interrupt = Interrupt::default();
    interrupt.request();
    interrupt.accept();
    assert!(!interrupt.requested());
    // It would end the process of the tests.
    interrupt.exit_when_overdue();
    assert!(!interrupt.shared.is_overdue.load(Ordering::SeqCst));
}
