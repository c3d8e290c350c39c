//! Items of the columns of a result, as rows of numbers.

use nalgebra::{Matrix3, Quaternion, Translation3, UnitQuaternion, Vector2};
use npyz::AutoSerialize;

use crate::geometry::{Pose2, Pose3};

/// An item of a column, as a row of `N` numbers.
pub trait Row<const N: usize>: Sized {
    /// Type of the numbers in the file.
    type Number: AutoSerialize + Copy;
    /// Number in the rows before the first localized frame.
    const EMPTY: Self::Number;

    /// The row of the item.
    fn to_row(&self) -> [Self::Number; N];

    /// The item of a row; `None` if no item has it.
    fn from_row(row: [f64; N]) -> Option<Self>;
}

impl Row<1> for f64 {
    type Number = Self;
    const EMPTY: Self = Self::NAN;

    fn to_row(&self) -> [Self; 1] {
        [*self]
    }

    fn from_row([number]: [Self; 1]) -> Option<Self> {
        Some(number)
    }
}

/// Before and after.
impl Row<2> for [f64; 2] {
    type Number = f64;
    const EMPTY: f64 = f64::NAN;

    fn to_row(&self) -> Self {
        *self
    }

    fn from_row(row: Self) -> Option<Self> {
        Some(row)
    }
}

impl Row<1> for u8 {
    type Number = Self;
    const EMPTY: Self = 0;

    fn to_row(&self) -> [Self; 1] {
        [*self]
    }

    fn from_row([number]: [f64; 1]) -> Option<Self> {
        Some(number as Self).filter(|&it| f64::from(it) == number)
    }
}

/// x, y [m], heading [rad].
impl Row<3> for Pose2 {
    type Number = f64;
    const EMPTY: f64 = f64::NAN;

    fn to_row(&self) -> [f64; 3] {
        let t = self.translation;
        [t.x, t.y, self.rotation.angle()]
    }

    fn from_row([x, y, heading]: [f64; 3]) -> Option<Self> {
        Some(Self::new(Vector2::new(x, y), heading))
    }
}

/// x, y, z [m], quaternion x, y, z, w.
impl Row<7> for Pose3 {
    type Number = f64;
    const EMPTY: f64 = f64::NAN;

    fn to_row(&self) -> [f64; 7] {
        let (t, q) = (self.translation, self.rotation);
        [t.x, t.y, t.z, q.i, q.j, q.k, q.w]
    }

    /// The rotation of a row of zeros is the identity.
    fn from_row([x, y, z, i, j, k, w]: [f64; 7]) -> Option<Self> {
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), f64::MIN_POSITIVE);
        let translation = Translation3::new(x, y, z);
        Some(Self::from_parts(translation, rotation.unwrap_or_default()))
    }
}

/// Row-major.
impl Row<9> for Matrix3<f64> {
    type Number = f64;
    const EMPTY: f64 = f64::NAN;

    fn to_row(&self) -> [f64; 9] {
        std::array::from_fn(|index| self[(index / 3, index % 3)])
    }

    fn from_row(row: [f64; 9]) -> Option<Self> {
        Some(Self::from_row_slice(&row))
    }
}
