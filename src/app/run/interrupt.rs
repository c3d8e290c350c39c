//! Ctrl-C and every other signal that asks a process to end: the first stops a command at the next point
//! without loss, at the latest after `GRACE`; the second exits at once.
//!
//! Loops poll [`Interrupt::requested`]. For what lasts longer, the process ends while it runs: files
//! are written atomically, so what is finished stays. A command whose finished work is still in memory
//! saves it by [`Interrupt::supervise`].

use std::fs;
use std::io;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use signal_hook::consts::signal::{
    SIGALRM, SIGHUP, SIGINT, SIGPROF, SIGQUIT, SIGTERM, SIGUSR1, SIGUSR2, SIGVTALRM, SIGXCPU,
    SIGXFSZ,
};
use signal_hook::flag;
use signal_hook::iterator::Signals;

use crate::files;
use crate::map::BuildError;
use crate::mapping::MappingError;

/// The signals that end a process by default, can be handled, and do not report a fault of the program: those of
/// terminals, service managers, batch systems (`USR1`, `USR2`) and limits of time (`XCPU`, and those of timers).
const SIGNALS: [i32; 10] = [
    SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGUSR1, SIGUSR2, SIGALRM, SIGXCPU, SIGVTALRM, SIGPROF,
];

/// Time from the request to stop until the process ends.
const GRACE: Duration = Duration::from_millis(800);

/// Longest time that the end of a process waits for a message: a terminal may be stopped, or a pipe full.
const MESSAGE_WAIT: Duration = Duration::from_millis(500);

/// Time between two looks at the request.
const POLL: Duration = Duration::from_millis(20);

/// Request of the user to stop, which loops poll; not requested by default.
#[derive(Clone, Debug, Default)]
pub struct Interrupt {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    requested: AtomicBool,
    /// Whether the time after the request has passed.
    is_overdue: AtomicBool,
    /// Whether [`Interrupt::supervise`] ends the process.
    is_supervised: AtomicBool,
    /// Whether a request was the end of a drive: the next signal ends the process.
    is_accepted: AtomicBool,
    /// Held while files are written that belong together.
    saving: Mutex<()>,
    /// What is finished and kept, and where; empty if a command has not set it.
    kept: Mutex<String>,
}

/// Error of a command that the user interrupted.
#[derive(Debug, thiserror::Error)]
#[error("interrupted; {kept}")]
pub struct Interrupted {
    /// What is finished and kept, and where.
    pub kept: String,
}

impl Interrupt {
    /// Listens for the signals; only once per process.
    pub fn install() -> io::Result<Self> {
        let interrupt = Self::default();
        let handled = interrupt.clone();
        let ignored = ignored_signals();
        let is_ignored = |signal: i32| ignored >> (signal - 1) & 1 == 1;
        // A file beyond the limit of the shell is an error of its writer then, as on a full disk.
        flag::register(SIGXFSZ, Arc::default())?;
        let mut signals = Signals::new(SIGNALS.into_iter().filter(|it| !is_ignored(*it)))?;
        thread::spawn(move || signals.forever().for_each(|_signal| handled.signalled()));
        Ok(interrupt)
    }

    fn signalled(&self) {
        let is_accepted = self.shared.is_accepted.load(Ordering::Relaxed);
        if self.shared.requested.swap(true, Ordering::Relaxed) || is_accepted {
            files::abandon_writes();
            exit();
        }
        let watched = self.clone();
        thread::spawn(move || watched.exit_when_overdue());
        // The reader of the messages may have stopped: neither the next signal nor the end of the process waits for it.
        thread::spawn(|| {
            tracing::warn!(
                "interrupted: keeping what is finished; press Ctrl-C again to stop at once"
            );
        });
    }

    /// Whether a signal has requested to stop.
    pub fn requested(&self) -> bool {
        self.shared.requested.load(Ordering::Relaxed)
    }

    /// The answer to events of the library: `Break` once it is requested to stop.
    pub fn flow(&self) -> ControlFlow<()> {
        if self.requested() {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    }

    /// Requests to stop, as a signal does.
    pub fn request(&self) {
        self.shared.requested.store(true, Ordering::Relaxed);
    }

    /// Takes a request to stop as the end of a drive that has no other: what follows may last. The next signal ends the process.
    pub fn accept(&self) {
        self.shared.is_accepted.store(true, Ordering::Relaxed);
        self.shared.requested.store(false, Ordering::Relaxed);
    }

    /// Sets what is finished and kept from now on, for the message of an interruption.
    pub fn keeps(&self, kept: impl Into<String>) {
        *lock(&self.shared.kept) = kept.into();
    }

    /// The error of an interruption, which names what is kept.
    pub fn error(&self) -> Interrupted {
        let mut kept = lock(&self.shared.kept).clone();
        if kept.is_empty() {
            "every output file that exists is complete".clone_into(&mut kept);
        }
        Interrupted { kept }
    }

    /// An error once it is requested to stop.
    pub fn check(&self) -> Result<(), Interrupted> {
        if self.requested() {
            return Err(self.error());
        }
        Ok(())
    }

    /// An error of the library; where it is an interruption, one that names what is kept.
    pub fn explain(&self, error: impl Into<anyhow::Error>) -> anyhow::Error {
        let error = error.into();
        let is_build = matches!(error.downcast_ref(), Some(BuildError::Interrupted));
        let is_mapping = matches!(error.downcast_ref(), Some(MappingError::Interrupted));
        if is_build || is_mapping {
            return self.error().into();
        }
        error
    }

    /// Guard of files that belong together: the process does not end between them.
    pub fn saving(&self) -> MutexGuard<'_, ()> {
        lock(&self.shared.saving)
    }

    /// Does work of which finished parts are in memory. Where it does not end in time after a request to
    /// stop, `save` saves them and returns what is kept, and the process ends.
    pub fn supervise<T>(
        &self,
        work: impl FnOnce() -> T,
        save: impl FnOnce() -> anyhow::Result<String> + Send,
    ) -> T {
        self.shared.is_supervised.store(true, Ordering::SeqCst);
        let (working, worker) = channel::<()>();
        let supervise = move || {
            while let Err(RecvTimeoutError::Timeout) = worker.recv_timeout(POLL) {
                if self.shared.is_overdue.load(Ordering::SeqCst) {
                    match save() {
                        Ok(kept) => self.keeps(kept),
                        Err(error) => report(format!("{error:#}")),
                    }
                    self.exit_after_saving();
                }
            }
            self.shared.is_supervised.store(false, Ordering::SeqCst);
        };
        thread::scope(|scope| {
            scope.spawn(supervise);
            // Dropped at the end of the work, also by a panic.
            let _working = working;
            work()
        })
    }

    fn exit_when_overdue(&self) {
        thread::sleep(GRACE);
        if !self.requested() {
            return;
        }
        self.shared.is_overdue.store(true, Ordering::SeqCst);
        while self.shared.is_supervised.load(Ordering::SeqCst) {
            thread::sleep(POLL);
        }
        self.exit_after_saving();
    }

    fn exit_after_saving(&self) -> ! {
        let _saving = self.saving();
        files::abandon_writes();
        report(self.error().to_string());
        exit()
    }
}

/// Reports an error, and waits for its reader a while only.
fn report(error: String) {
    let (sender, written) = channel::<()>();
    thread::spawn(move || {
        tracing::error!("{error}");
        drop(sender);
    });
    let _ = written.recv_timeout(MESSAGE_WAIT);
}

/// A bit for each signal that was ignored at the start, as `nohup` and shells ask for, the first for signal 1; none where
/// the system does not say.
fn ignored_signals() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|it| it.strip_prefix("SigIgn:"));
    mask.map_or(0, |mask| u64::from_str_radix(mask.trim(), 16).unwrap_or(0))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[expect(clippy::exit, reason = "the user requested it, and files are complete")]
fn exit() -> ! {
    std::process::exit(130)
}

#[cfg(test)]
#[cfg(unix)]
#[path = "interrupt_tests.rs"]
mod tests;
