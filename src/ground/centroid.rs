//! The centroid of output sets that are clipped, or scaled, by how strongly their rules fire.

use super::membership::{Membership, Operators};

/// Intervals of the output's universe, 0 to 1, over which a centroid is integrated.
const INTERVALS: usize = 64;
/// Strengths along each axis of the table of centroids.
const NODES: usize = 33;
/// Below this greatest strength the centroid changes too fast for a table.
pub(super) const MIN_TABLED: f32 = 0.1;

/// The result where no rule fires: nothing is known.
pub(super) const UNKNOWN: f32 = 0.5;

/// Output sets, and for three of them a table of centroids.
#[derive(Clone, Debug)]
pub(super) struct Centroids {
    operators: Operators,
    /// Degrees of the output sets over the universe.
    curves: Vec<[f32; INTERVALS + 1]>,
    /// The centroid by the strengths of three output sets, on a grid of `NODES`³; empty for
    /// another number of sets.
    table: Vec<f32>,
}

impl Centroids {
    /// Of output sets; what they weigh depends on how rules imply them.
    pub(super) fn new(outputs: &[Membership], operators: Operators) -> Self {
        let curve = |shape: &Membership| -> [f32; INTERVALS + 1] {
            std::array::from_fn(|i| shape.degree(i as f32 / INTERVALS as f32))
        };
        let mut centroids = Self {
            operators,
            curves: outputs.iter().map(curve).collect(),
            table: Vec::new(),
        };
        if outputs.len() == 3 {
            let node = |index: usize| (index % NODES) as f32 / (NODES - 1) as f32;
            centroids.table = (0..NODES * NODES * NODES)
                .map(|index| {
                    let strengths = [index / (NODES * NODES), index / NODES, index].map(node);
                    centroids.integrate(strengths.into_iter())
                })
                .collect();
        }
        centroids
    }

    /// The centroids for `N` times the strengths of the output sets; [`UNKNOWN`] where all are 0.
    #[inline]
    pub(super) fn of<const N: usize>(&self, strengths: &[[f32; N]]) -> [f32; N] {
        let integrate = |i: usize| {
            let strengths = strengths.iter().map(|set| set[i]);
            self.integrate(strengths)
        };
        match strengths {
            [a, b, c] if !self.table.is_empty() => std::array::from_fn(|i| {
                if a[i].max(b[i]).max(c[i]) >= MIN_TABLED {
                    self.look_up([a[i], b[i], c[i]])
                } else {
                    integrate(i)
                }
            }),
            _ => std::array::from_fn(integrate),
        }
    }

    /// The centroid of the union of the clipped output sets.
    pub(super) fn integrate(&self, strengths: impl Iterator<Item = f32>) -> f32 {
        let mut union = [0.0_f32; INTERVALS + 1];
        for (curve, strength) in self.curves.iter().zip(strengths) {
            for (joined, &degree) in union.iter_mut().zip(curve) {
                let implied = match self.operators {
                    Operators::MinMax => degree.min(strength),
                    Operators::Product => degree * strength,
                };
                *joined = joined.max(implied);
            }
        }
        center_of_area(&union)
    }

    /// The centroid between the eight nearest nodes of the table.
    #[inline]
    pub(super) fn look_up(&self, strengths: [f32; 3]) -> f32 {
        let mut base = 0;
        let mut share = [0.0; 3];
        for (share, strength) in share.iter_mut().zip(strengths) {
            let position = strength * (NODES - 1) as f32;
            let node = (position as usize).min(NODES - 2);
            *share = position - node as f32;
            base = base * NODES + node;
        }
        let along = |base: usize| {
            let (low, high) = (self.table[base], self.table[base + 1]);
            low + share[2] * (high - low)
        };
        let across = |base: usize| {
            let (low, high) = (along(base), along(base + NODES));
            low + share[1] * (high - low)
        };
        let (low, high) = (across(base), across(base + NODES * NODES));
        low + share[0] * (high - low)
    }
}

/// The centroid of a curve that is straight between its samples over 0 to 1.
fn center_of_area(curve: &[f32; INTERVALS + 1]) -> f32 {
    let (mut area, mut moment) = (0.0, 0.0);
    for (interval, ends) in curve.windows(2).enumerate() {
        let (a, b) = (ends[0], ends[1]);
        area += 0.5 * (a + b);
        // ∫ t (a + (b − a) t) dt = a/2 + (b − a)/3 over the interval, from its left end.
        moment += interval as f32 * 0.5 * (a + b) + a / 6.0 + b / 3.0;
    }
    if area > 0.0 {
        moment / area / INTERVALS as f32
    } else {
        UNKNOWN
    }
}
