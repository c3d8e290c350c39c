//! Several batches of work in flight; their results are read in the order of submission.

use std::collections::VecDeque;

use super::batch_sizes::IN_FLIGHT;
use super::device::{Gpu, InFlight};
use crate::rendering::RenderError;

/// Starts every batch, and finishes it before more than [`IN_FLIGHT`] have been started.
pub(super) fn run<B>(
    gpu: &Gpu,
    batches: impl IntoIterator<Item = B>,
    mut start: impl FnMut(&B) -> InFlight,
    mut finish: impl FnMut(B, Vec<f32>),
) -> Result<(), RenderError> {
    let mut started: VecDeque<(B, InFlight)> = VecDeque::new();
    for batch in batches {
        if started.len() == IN_FLIGHT {
            finish_first(gpu, &mut started, &mut finish)?;
        }
        let work = start(&batch);
        gpu.check()?;
        started.push_back((batch, work));
    }
    while !started.is_empty() {
        finish_first(gpu, &mut started, &mut finish)?;
    }
    Ok(())
}

fn finish_first<B>(
    gpu: &Gpu,
    started: &mut VecDeque<(B, InFlight)>,
    finish: &mut impl FnMut(B, Vec<f32>),
) -> Result<(), RenderError> {
    if let Some((batch, work)) = started.pop_front() {
        finish(batch, gpu.fetch(&work)?);
    }
    Ok(())
}
