//! Centroid defuzzification of the aggregated output of Mamdani inference.
//!
//! ```text
//! y = ∫ y µ(y) dy / ∫ µ(y) dy,    µ(y) = maxᵢ (sᵢ ∧ µᵢ(y))
//! ```
//!
//! For three output sets, the common case, the centroid is tabulated by their firing strengths.

use super::membership::{MembershipFunction, Operators};

/// Intervals of the output's universe, 0 to 1, over which a centroid is integrated.
const INTERVALS: usize = 64;
/// Nodes along each axis of the table of centroids.
const NODES: usize = 33;
/// Below this maximum firing strength the centroid changes too fast for the table.
pub(super) const MIN_TABULATED: f32 = 0.1;
/// The result where no rule fires.
pub(super) const UNDECIDED: f32 = 0.5;

/// The membership functions of the output sets as samples, and the table of their centroids.
#[derive(Clone, Debug)]
pub(super) struct CentroidDefuzzifier {
    operators: Operators,
    /// Degrees of the output sets over the universe.
    curves: Vec<[f32; INTERVALS + 1]>,
    /// The centroid on a grid of `NODES`³ firing strengths; empty unless there are three sets.
    table: Vec<f32>,
}

impl CentroidDefuzzifier {
    pub(super) fn new(outputs: &[MembershipFunction], operators: Operators) -> Self {
        let curve = |function: &MembershipFunction| {
            std::array::from_fn(|i| function.degree(i as f32 / INTERVALS as f32))
        };
        let mut defuzzifier = Self {
            operators,
            curves: outputs.iter().map(curve).collect(),
            table: Vec::new(),
        };
        if outputs.len() == 3 {
            let node = |index: usize| (index % NODES) as f32 / (NODES - 1) as f32;
            defuzzifier.table = (0..NODES * NODES * NODES)
                .map(|index| {
                    let strengths = [index / (NODES * NODES), index / NODES, index].map(node);
                    defuzzifier.integrate(strengths.into_iter())
                })
                .collect();
        }
        defuzzifier
    }

    /// Returns the centroids for `N` columns of firing strengths, `strengths[set][column]`.
    #[inline(always)]
    pub(super) fn defuzzify<const N: usize>(&self, strengths: &[[f32; N]]) -> [f32; N] {
        let [a, b, c] = strengths else {
            return std::array::from_fn(|i| self.integrate(strengths.iter().map(|set| set[i])));
        };
        // The strengths of neighbouring points are mostly the same.
        let mut last = ([0.0; 3], UNDECIDED);
        std::array::from_fn(|i| {
            let strengths = [a[i], b[i], c[i]];
            if strengths != last.0 {
                last = (strengths, self.centroid(strengths));
            }
            last.1
        })
    }

    /// Returns the centroid for the firing strengths of three output sets.
    fn centroid(&self, strengths: [f32; 3]) -> f32 {
        if strengths.into_iter().fold(0.0, f32::max) >= MIN_TABULATED {
            self.interpolate(strengths)
        } else {
            self.integrate(strengths.into_iter())
        }
    }

    /// Integrates the centroid over the union of the implied output sets; [`UNDECIDED`] where all
    /// strengths are 0.
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

    /// Interpolates the centroid between the eight nearest nodes of the table.
    #[inline]
    pub(super) fn interpolate(&self, strengths: [f32; 3]) -> f32 {
        let mut base = 0;
        let mut share = [0.0; 3];
        for (share, strength) in share.iter_mut().zip(strengths) {
            let position = strength * (NODES - 1) as f32;
            let node = (position as usize).min(NODES - 2);
            *share = position - node as f32;
            base = base * NODES + node;
        }
        let mix = |share: f32, low: f32, high: f32| low + share * (high - low);
        let edge = |base: usize| mix(share[2], self.table[base], self.table[base + 1]);
        let face = |base: usize| mix(share[1], edge(base), edge(base + NODES));
        mix(share[0], face(base), face(base + NODES * NODES))
    }
}

/// Returns the centroid of a piecewise linear curve over 0 to 1.
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
        UNDECIDED
    }
}
