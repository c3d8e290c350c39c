//! The library's log goes to Python's logger `fpmcl`.

use std::fmt::{self, Write as _};
use std::sync::Once;

use pyo3::prelude::*;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::{Context, SubscriberExt as _};
use tracing_subscriber::util::SubscriberInitExt as _;

/// Starts to forward the log; later calls have no effect.
pub fn start() {
    static STARTED: Once = Once::new();
    STARTED.call_once(|| {
        let filter = Targets::new().with_target("fpmcl", Level::INFO);
        // It fails only where the program has started its own log.
        let _ = tracing_subscriber::registry()
            .with(PythonLogger.with_filter(filter))
            .try_init();
    });
}

struct PythonLogger;

impl<S: Subscriber> Layer<S> for PythonLogger {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let level = match *event.metadata().level() {
            Level::ERROR => 40,
            Level::WARN => 30,
            _ => 20,
        };
        let mut message = Message(String::new());
        event.record(&mut message);
        let logged = Python::attach(|py| {
            let logger = (py.import("logging")?).call_method1("getLogger", ("fpmcl",))?;
            logger
                .call_method1("log", (level, "%s", message.0))
                .map(drop)
        });
        // An error of the logger cannot be logged.
        drop(logged);
    }
}

/// The message of an event.
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            // Writing to a string cannot fail.
            let _ = write!(self.0, "{value:?}");
        }
    }
}
