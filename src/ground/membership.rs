//! Membership functions of fuzzy sets: the degree, 0 to 1, to which a number belongs to a set.
//!
//! Zadeh, *Fuzzy Sets* (1965); shapes as in scikit-fuzzy and MATLAB.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Fuzzy operators for AND, OR and implication.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Operators {
    /// Minimum for AND and implication, maximum for OR.
    #[default]
    MinMax,
    /// Product for AND and implication, probabilistic sum for OR.
    Product,
}

/// The membership function of a fuzzy set, by its corners in ascending order.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum MembershipFunction {
    /// 0 up to the first corner, 1 between the second and the third, 0 from the fourth on.
    Trapezoid([f32; 4]),
    /// 0 up to the first corner, 1 at the second, 0 from the third on.
    Triangle([f32; 3]),
    /// 1 up to the first corner, 0 from the second on.
    LeftShoulder([f32; 2]),
    /// 0 up to the first corner, 1 from the second on.
    RightShoulder([f32; 2]),
    /// `exp(-½ (x − mean)² / sigma²)`: mean, then sigma.
    Gaussian([f32; 2]),
}

impl MembershipFunction {
    /// Returns the degree of membership of `x`; 0 for NaN.
    pub(crate) fn degree(&self, x: f32) -> f32 {
        let mut degree = [0.0];
        self.degrees(&[x], &mut degree);
        degree[0]
    }

    /// Computes the degrees of membership of `N` numbers.
    #[inline(always)]
    pub(super) fn degrees<const N: usize>(&self, xs: &[f32; N], degrees: &mut [f32; N]) {
        let pairs = degrees.iter_mut().zip(xs);
        // One loop per shape, so that each is vectorized.
        match *self {
            Self::Trapezoid([a, b, c, d]) => {
                pairs.for_each(|(degree, &x)| *degree = rise(x, a, b).min(fall(x, c, d)))
            }
            Self::Triangle([a, b, c]) => {
                pairs.for_each(|(degree, &x)| *degree = rise(x, a, b).min(fall(x, b, c)))
            }
            Self::LeftShoulder([a, b]) => pairs.for_each(|(degree, &x)| *degree = fall(x, a, b)),
            Self::RightShoulder([a, b]) => pairs.for_each(|(degree, &x)| *degree = rise(x, a, b)),
            Self::Gaussian([mean, sigma]) => pairs.for_each(|(degree, &x)| {
                let deviation = (x - mean) / sigma;
                // The maximum of NaN and 0 is 0.
                *degree = (-0.5 * deviation * deviation).exp().max(0.0);
            }),
        }
    }

    /// Whether the corners are finite and ascend, and a standard deviation is positive.
    pub(crate) fn is_valid(&self) -> bool {
        let corners = self.corners();
        let is_ordered = match *self {
            Self::Gaussian([_, sigma]) => sigma > 0.0,
            _ => corners.is_sorted(),
        };
        is_ordered && corners.iter().all(|corner| corner.is_finite())
    }

    /// The condition of [`is_valid`](Self::is_valid), for error messages.
    pub(crate) fn requirement(&self) -> &'static str {
        match self {
            Self::Gaussian(_) => "its mean must be finite and its sigma greater than 0",
            _ => "its corners must be finite and ascend",
        }
    }

    /// The interval in which the degree changes; three sigmas to both sides for a Gaussian.
    pub(crate) fn span(&self) -> (f32, f32) {
        match *self {
            Self::Trapezoid([a, .., d]) => (a, d),
            Self::Triangle([a, _, c]) => (a, c),
            Self::LeftShoulder([a, b]) | Self::RightShoulder([a, b]) => (a, b),
            Self::Gaussian([mean, sigma]) => (mean - 3.0 * sigma, mean + 3.0 * sigma),
        }
    }

    /// The centre of the values of full degree within 0 to 1: the singleton that replaces the set
    /// in zero-order Sugeno inference.
    pub(super) fn peak_in_unit_interval(&self) -> f32 {
        let peak: f32 = match *self {
            Self::Trapezoid([_, b, c, _]) => 0.5 * (b + c),
            Self::Triangle([_, b, _]) => b,
            Self::LeftShoulder(_) => 0.0,
            Self::RightShoulder(_) => 1.0,
            Self::Gaussian([mean, _]) => mean,
        };
        peak.clamp(0.0, 1.0)
    }

    fn corners(&self) -> &[f32] {
        match self {
            Self::Trapezoid(corners) => corners,
            Self::Triangle(corners) => corners,
            Self::LeftShoulder(corners) | Self::RightShoulder(corners) => corners,
            Self::Gaussian(parameters) => parameters,
        }
    }
}

/// The notation of configuration files.
impl fmt::Display for MembershipFunction {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let shape = match self {
            Self::Trapezoid(_) => "trapezoid",
            Self::Triangle(_) => "triangle",
            Self::LeftShoulder(_) => "left_shoulder",
            Self::RightShoulder(_) => "right_shoulder",
            Self::Gaussian(_) => "gaussian",
        };
        write!(f, "{{{shape}: {:?}}}", self.corners())
    }
}

/// A flank that is 0 up to `a` and 1 from `b` on; a step where both are equal; 0 for NaN.
#[inline(always)]
fn rise(x: f32, a: f32, b: f32) -> f32 {
    // NaN where a = b, but then it is not used.
    let between = (x - a) / (b - a);
    if x >= b {
        1.0
    } else if x > a {
        between
    } else {
        0.0
    }
}

/// A flank that is 1 up to `a` and 0 from `b` on; 0 for NaN.
#[inline(always)]
fn fall(x: f32, a: f32, b: f32) -> f32 {
    rise(-x, -b, -a)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPES: [MembershipFunction; 5] = [
        MembershipFunction::Trapezoid([1.0, 2.0, 3.0, 5.0]),
        MembershipFunction::Triangle([1.0, 2.0, 5.0]),
        MembershipFunction::LeftShoulder([2.0, 4.0]),
        MembershipFunction::RightShoulder([2.0, 4.0]),
        MembershipFunction::Gaussian([2.0, 0.5]),
    ];

    #[test]
    fn degrees_lie_between_0_and_1_and_are_0_for_nan() {
        for shape in SHAPES {
            for step in -100..100 {
                let degree = shape.degree(0.1 * step as f32);
                assert!((0.0..=1.0).contains(&degree), "{shape:?}");
            }
            assert_eq!(shape.degree(f32::NAN), 0.0, "{shape:?}");
            assert!(shape.is_valid());
        }
    }

    #[test]
    fn left_and_right_shoulder_sum_to_one() {
        for step in 0..60 {
            let x = 0.1 * step as f32;
            let sum = SHAPES[2].degree(x) + SHAPES[3].degree(x);
            assert!((sum - 1.0).abs() < 1e-6, "{x}");
        }
    }

    #[test]
    fn a_trapezoid_is_one_at_its_top_and_half_at_the_middle_of_its_flanks() {
        let degrees = [0.9, 1.5, 2.0, 2.7, 3.0, 4.0, 5.1].map(|x| SHAPES[0].degree(x));
        assert_eq!(degrees, [0.0, 0.5, 1.0, 1.0, 1.0, 0.5, 0.0]);
    }

    #[test]
    fn vertical_flanks_are_steps() {
        let step = MembershipFunction::Trapezoid([1.0, 1.0, 2.0, 2.0]);
        let degrees = [0.99, 1.0, 2.0, 2.01].map(|x| step.degree(x));
        assert_eq!(degrees, [0.0, 1.0, 1.0, 0.0]);
    }

    #[test]
    fn descending_corners_are_invalid() {
        assert!(!MembershipFunction::Triangle([2.0, 1.0, 3.0]).is_valid());
        assert!(!MembershipFunction::LeftShoulder([f32::NAN, 1.0]).is_valid());
        assert!(!MembershipFunction::Gaussian([0.0, 0.0]).is_valid());
    }
}
