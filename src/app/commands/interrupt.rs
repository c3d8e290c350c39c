//! Ctrl-C: the first stops a command at the next point without loss, the second exits at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Request of the user to stop, which loops poll; not requested by default.
#[derive(Clone, Debug, Default)]
pub struct Interrupt {
    requested: Arc<AtomicBool>,
}

/// Error of a command that the user interrupted.
#[derive(Debug, thiserror::Error)]
#[error("interrupted; {kept}")]
pub struct Interrupted {
    /// What is finished and kept, and where.
    pub kept: String,
}

impl Interrupt {
    /// Installs the handler of Ctrl-C; only once per process.
    pub fn install() -> Result<Self, ctrlc::Error> {
        let interrupt = Self::default();
        let requested = Arc::clone(&interrupt.requested);
        ctrlc::set_handler(move || {
            if requested.swap(true, Ordering::Relaxed) {
                kill();
            }
            tracing::warn!(
                "interrupted: keeping what is finished; press Ctrl-C again to stop at once"
            );
        })?;
        Ok(interrupt)
    }

    /// Whether Ctrl-C was pressed.
    pub fn requested(&self) -> bool {
        self.requested.load(Ordering::Relaxed)
    }

    /// Requests to stop, as Ctrl-C does.
    pub fn request(&self) {
        self.requested.store(true, Ordering::Relaxed);
    }
}

#[expect(clippy::exit, reason = "the user requested it a second time")]
fn kill() {
    std::process::exit(130)
}

#[cfg(all(test, unix))]
mod tests {
    use std::process::Command;
    use std::time::{Duration, Instant};

    use super::*;

    #[test]
    fn ctrl_c_is_seen_by_every_copy() {
        let interrupt = Interrupt::install().unwrap();
        let copy = interrupt.clone();
        assert!(!copy.requested());
        let pid = std::process::id().to_string();
        let sent = Command::new("kill").args(["-INT", &pid]).status().unwrap();
        assert!(sent.success());
        let start = Instant::now();
        while !copy.requested() && start.elapsed() < Duration::from_secs(20) {
            std::thread::sleep(Duration::from_millis(5));
        }
        assert!(copy.requested() && interrupt.requested());
    }
}
