//! Several batches of work in flight, their results taken in the order in which they were given.

use std::collections::VecDeque;

use super::device::{Gpu, InFlight};
use crate::rendering::RenderError;
use crate::rendering::backend::AdapterKind;

/// How much is given to the device at once.
#[derive(Clone, Copy, Debug)]
pub(super) struct BatchSizes {
    /// Rays whose ranges are read back.
    pub ranges: usize,
    /// Beams that are compared.
    pub beams: usize,
    /// Directions, which are counted in work groups of one dimension (65,535 of 64).
    pub directions: usize,
    /// Poses, which are the work groups of the other dimension.
    pub poses: usize,
    /// Images in an atlas.
    pub images: usize,
    /// Vertices of an atlas.
    pub vertices: usize,
}

impl BatchSizes {
    /// As much as takes a fraction of a second, and 16 MB of results; on a software adapter some
    /// seconds.
    pub fn of(kind: AdapterKind) -> Self {
        let shorter = if kind == AdapterKind::Software { 64 } else { 1 };
        Self {
            ranges: (1 << 22) / shorter,
            beams: (1 << 24) / shorter,
            directions: 1 << 20,
            poses: 65_535,
            images: 64,
            vertices: (1 << 29) / shorter,
        }
    }
}

/// While one is read back, one runs and one waits.
const IN_FLIGHT: usize = 3;

/// Starts every batch and finishes it once so many others have been started after it.
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
