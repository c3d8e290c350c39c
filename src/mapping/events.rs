//! Events of a search for poses.

use std::ops::ControlFlow;

use super::error::MappingError;
use crate::map::BuildEvent;

/// Called for every event; the work ends soon after it returns `Break`.
pub type OnEvent<'a> = &'a dyn Fn(BuildEvent) -> ControlFlow<()>;

/// Announces an event; an error where it is answered with `Break`.
pub fn notify(on_event: OnEvent, event: BuildEvent) -> Result<(), MappingError> {
    match on_event(event) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(MappingError::Interrupted),
    }
}
