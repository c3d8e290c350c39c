//! Wall time per stage of a build.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard};
use std::time::Instant;

/// Wall time per stage.
#[derive(Default)]
pub struct StageClock {
    state: Mutex<ClockState>,
}

#[derive(Default)]
struct ClockState {
    running: Option<(&'static str, Instant)>,
    seconds: BTreeMap<String, f64>,
}

impl StageClock {
    /// Ends the running stage and begins another.
    pub fn begin(&self, name: &'static str) {
        self.end();
        self.state().running = Some((name, Instant::now()));
    }

    /// Ends the running stage.
    pub fn end(&self) {
        let mut state = self.state();
        if let Some((name, since)) = state.running.take() {
            *state.seconds.entry(name.to_owned()).or_default() += since.elapsed().as_secs_f64();
        }
    }

    /// Measures a stage.
    pub fn time<T>(&self, name: &'static str, work: impl FnOnce() -> T) -> T {
        self.begin(name);
        let result = work();
        self.end();
        result
    }

    /// Seconds per stage.
    pub fn seconds(&self) -> BTreeMap<String, f64> {
        self.state().seconds.clone()
    }

    fn state(&self) -> MutexGuard<'_, ClockState> {
        self.state
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}
