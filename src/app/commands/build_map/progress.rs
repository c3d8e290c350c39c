//! Progress of a build, and the wall time of its stages.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use crate::app::run::Task;

/// Stages of a local map, and about the share of its time before each.
const STAGES: [(&str, f64); 6] = [
    ("scans", 0.0),
    ("moving points", 0.4),
    ("surface", 0.65),
    ("false surfaces", 0.85),
    ("changes", 0.95),
    ("ground", 0.97),
];

/// Share of all work that is left when the local maps are finished.
const JOINING: f64 = 0.03;

/// Progress through the local maps, in scans, and wall time per stage.
pub struct BuildProgress {
    task: Arc<Task>,
    /// Scans of all local maps; a scan that is in two local maps counts twice.
    scans: usize,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Scans of the finished local maps, and of the current one.
    scans: (usize, usize),
    running: Option<(&'static str, Instant)>,
    seconds: BTreeMap<String, f64>,
}

impl BuildProgress {
    /// Progress of a task with a number of scans in all local maps.
    pub fn new(task: Arc<Task>, scans: usize) -> Self {
        let state = Mutex::default();
        Self { task, scans, state }
    }

    /// Begins a local map after the ones before it.
    pub fn begin_local_map(&self, scans: usize) {
        let mut state = self.state();
        state.scans = (state.scans.0 + state.scans.1, scans);
        self.show(state.scans, 0.0);
    }

    /// Ends the running stage and begins another.
    pub fn begin(&self, name: &'static str) {
        self.end();
        self.task.note(name);
        let mut state = self.state();
        state.running = Some((name, Instant::now()));
        if let Some((_, share)) = STAGES.iter().find(|(stage, _)| *stage == name) {
            self.show(state.scans, *share);
        }
    }

    /// Counts a scan of the current local map.
    pub fn end_scan(&self) {
        let share = STAGES[1].1 * (1.0 - JOINING) / self.scans.max(1) as f64;
        self.task.advance_share(share);
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

    /// Ends the task; returns the seconds per stage.
    pub fn finish(&self) -> BTreeMap<String, f64> {
        self.task.set_share(1.0);
        self.state().seconds.clone()
    }

    fn show(&self, (finished, current): (usize, usize), share: f64) {
        let done = finished as f64 + share * current as f64;
        let share = (1.0 - JOINING) * done / self.scans.max(1) as f64;
        self.task.set_share(share);
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
