//! Degrees of membership: how much a number belongs to a linguistic set, 0 to 1.
//!
//! Zadeh, *Fuzzy Sets* (1965); shapes as in scikit-fuzzy and MATLAB.

use std::fmt;

use serde::{Deserialize, Serialize};

/// How AND, OR and implication are computed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Operators {
    /// AND is the smaller degree, OR the larger.
    #[default]
    MinMax,
    /// AND is the product, OR the probabilistic sum.
    Product,
}

/// The shape of a linguistic set over its variable. Corners ascend.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Membership {
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

impl Membership {
    /// The degree to which `x` belongs to the set; 0 for NaN.
    #[inline]
    pub fn degree(&self, x: f32) -> f32 {
        match *self {
            Self::Trapezoid([a, b, c, d]) => rise(x, a, b).min(rise(-x, -d, -c)),
            Self::Triangle([a, b, c]) => rise(x, a, b).min(rise(-x, -c, -b)),
            Self::LeftShoulder([c, d]) => rise(-x, -d, -c),
            Self::RightShoulder([a, b]) => rise(x, a, b),
            Self::Gaussian([mean, sigma]) => {
                let deviation = (x - mean) / sigma;
                if deviation.is_nan() {
                    0.0
                } else {
                    (-0.5 * deviation * deviation).exp()
                }
            }
        }
    }

    /// The degrees of `N` numbers.
    #[inline]
    pub(super) fn degrees<const N: usize>(&self, xs: &[f32; N], degrees: &mut [f32; N]) {
        let pairs = degrees.iter_mut().zip(xs);
        // The shape is told apart outside of the loops, so that these are vectorized.
        match *self {
            Self::LeftShoulder([c, d]) => pairs.for_each(|(degree, &x)| *degree = rise(-x, -d, -c)),
            Self::RightShoulder([a, b]) => pairs.for_each(|(degree, &x)| *degree = rise(x, a, b)),
            Self::Triangle([a, b, c]) => {
                pairs.for_each(|(degree, &x)| *degree = rise(x, a, b).min(rise(-x, -c, -b)))
            }
            shape => pairs.for_each(|(degree, &x)| *degree = shape.degree(x)),
        }
    }

    /// Whether the corners are finite and ascend, and a spread is positive.
    pub fn is_valid(&self) -> bool {
        match self {
            Self::Trapezoid(corners) => ascends(corners),
            Self::Triangle(corners) => ascends(corners),
            Self::LeftShoulder(corners) | Self::RightShoulder(corners) => ascends(corners),
            Self::Gaussian([mean, sigma]) => mean.is_finite() && sigma.is_finite() && *sigma > 0.0,
        }
    }

    /// What [`is_valid`](Self::is_valid) asks for, as a remedy.
    pub fn law(&self) -> &'static str {
        match self {
            Self::Gaussian(_) => "its mean must be finite and its sigma greater than 0",
            _ => "its corners must be finite and ascend",
        }
    }

    /// Where the degree changes: from the first corner to the last, three sigmas for a Gaussian.
    pub fn span(&self) -> (f32, f32) {
        match *self {
            Self::Trapezoid([a, .., d]) => (a, d),
            Self::Triangle([a, _, c]) => (a, c),
            Self::LeftShoulder([a, b]) | Self::RightShoulder([a, b]) => (a, b),
            Self::Gaussian([mean, sigma]) => (mean - 3.0 * sigma, mean + 3.0 * sigma),
        }
    }

    /// The middle of the values of full degree within 0 to 1, where zero-order Sugeno inference
    /// puts the set's weight.
    pub(super) fn peak_in_unit_interval(&self) -> f32 {
        let (from, to) = match *self {
            Self::Trapezoid([_, b, c, _]) => (b, c),
            Self::Triangle([_, b, _]) => (b, b),
            // A shoulder stands for the end that it leans on.
            Self::LeftShoulder(_) => (0.0, 0.0),
            Self::RightShoulder(_) => (1.0, 1.0),
            Self::Gaussian([mean, _]) => (mean, mean),
        };
        (0.5 * (from + to)).clamp(0.0, 1.0)
    }
}

/// As it is written in a configuration.
impl fmt::Display for Membership {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Trapezoid(corners) => write!(f, "{{trapezoid: {corners:?}}}"),
            Self::Triangle(corners) => write!(f, "{{triangle: {corners:?}}}"),
            Self::LeftShoulder(corners) => write!(f, "{{left_shoulder: {corners:?}}}"),
            Self::RightShoulder(corners) => write!(f, "{{right_shoulder: {corners:?}}}"),
            Self::Gaussian(corners) => write!(f, "{{gaussian: {corners:?}}}"),
        }
    }
}

/// 0 up to `a`, 1 from `b` on, straight between; a step where both are the same; 0 for NaN.
#[inline]
fn rise(x: f32, a: f32, b: f32) -> f32 {
    // Not a number where a = b, but then it is not asked for.
    let between = (x - a) / (b - a);
    if x >= b {
        1.0
    } else if x > a {
        between
    } else {
        0.0
    }
}

fn ascends(corners: &[f32]) -> bool {
    corners.iter().all(|corner| corner.is_finite())
        && corners.windows(2).all(|pair| pair[0] <= pair[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPES: [Membership; 5] = [
        Membership::Trapezoid([1.0, 2.0, 3.0, 5.0]),
        Membership::Triangle([1.0, 2.0, 5.0]),
        Membership::LeftShoulder([2.0, 4.0]),
        Membership::RightShoulder([2.0, 4.0]),
        Membership::Gaussian([2.0, 0.5]),
    ];

    #[test]
    fn every_degree_lies_between_0_and_1_and_nothing_belongs_where_there_is_no_number() {
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
    fn left_and_right_shoulder_complement_each_other() {
        for step in 0..60 {
            let x = 0.1 * step as f32;
            let sum = SHAPES[2].degree(x) + SHAPES[3].degree(x);
            assert!((sum - 1.0).abs() < 1e-6, "{x}");
        }
    }

    #[test]
    fn a_trapezoid_is_one_on_its_top_and_half_on_the_middle_of_its_flanks() {
        let degrees = [0.9, 1.5, 2.0, 2.7, 3.0, 4.0, 5.1].map(|x| SHAPES[0].degree(x));
        assert_eq!(degrees, [0.0, 0.5, 1.0, 1.0, 1.0, 0.5, 0.0]);
    }

    #[test]
    fn upright_flanks_are_steps() {
        let step = Membership::Trapezoid([1.0, 1.0, 2.0, 2.0]);
        let degrees = [0.99, 1.0, 2.0, 2.01].map(|x| step.degree(x));
        assert_eq!(degrees, [0.0, 1.0, 1.0, 0.0]);
    }

    #[test]
    fn corners_that_descend_are_invalid() {
        assert!(!Membership::Triangle([2.0, 1.0, 3.0]).is_valid());
        assert!(!Membership::LeftShoulder([f32::NAN, 1.0]).is_valid());
        assert!(!Membership::Gaussian([0.0, 0.0]).is_valid());
    }
}
