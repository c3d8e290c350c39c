//! Columns of a result, and their items as rows of numbers.

use std::fmt;
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};

use bytemuck::Pod;

use nalgebra::{Matrix3, Quaternion, Translation3, UnitQuaternion, Vector2};
use npyz::AutoSerialize;
use serde::{Serialize, Serializer};

use crate::geometry::{Pose2, Pose3};
use crate::shared_bytes::GrowingBytes;

/// An item per frame: few in memory, many in an unnamed file, so that memory does not grow with a drive.
pub struct Column<T> {
    /// Folder of the file; by default that of temporary files.
    folder: Option<PathBuf>,
    items: Items<T>,
}

enum Items<T> {
    InMemory(Vec<T>),
    InFile(GrowingBytes, PhantomData<T>),
}

impl<T: Pod> Column<T> {
    /// Largest size of the items in memory [bytes].
    const MOST_BYTES: usize = 1 << 16;

    /// An empty column whose file is in a folder, if it can be written there.
    pub fn in_folder(folder: &Path) -> Self {
        Self {
            folder: Some(folder.to_owned()),
            items: Items::InMemory(Vec::new()),
        }
    }

    /// Appends an item. Where no file can be written, all stay in memory.
    pub fn push(&mut self, item: T) {
        if let Items::InFile(bytes, _) = &mut self.items {
            if bytes.extend(bytemuck::bytes_of(&item)).is_ok() {
                return;
            }
            self.items = Items::InMemory(self.to_vec());
        }
        if let Items::InMemory(items) = &mut self.items {
            // Where the vector must grow anyway.
            if items.len() == items.capacity() && size_of_val(&**items) >= Self::MOST_BYTES {
                let (folder, bytes) = (self.folder.as_deref(), bytemuck::cast_slice(items));
                if let Ok(mut bytes) = GrowingBytes::in_folder(folder, bytes)
                    && bytes.extend(bytemuck::bytes_of(&item)).is_ok()
                {
                    self.items = Items::InFile(bytes, PhantomData);
                    return;
                }
            }
            items.push(item);
        }
    }
}

impl<T: Pod> Deref for Column<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match &self.items {
            Items::InMemory(items) => items,
            Items::InFile(bytes, _) => bytemuck::cast_slice(bytes),
        }
    }
}

impl<T: Pod> DerefMut for Column<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.items {
            Items::InMemory(items) => items,
            Items::InFile(bytes, _) => bytemuck::cast_slice_mut(bytes),
        }
    }
}

impl<T> From<Vec<T>> for Column<T> {
    fn from(items: Vec<T>) -> Self {
        Self {
            folder: None,
            items: Items::InMemory(items),
        }
    }
}

impl<T> FromIterator<T> for Column<T> {
    fn from_iter<I: IntoIterator<Item = T>>(items: I) -> Self {
        Vec::from_iter(items).into()
    }
}

impl<'a, T: Pod> IntoIterator for &'a Column<T> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl<'a, T: Pod> IntoIterator for &'a mut Column<T> {
    type Item = &'a mut T;
    type IntoIter = std::slice::IterMut<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter_mut()
    }
}

impl<T: Pod + Serialize> Serialize for Column<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (**self).serialize(serializer)
    }
}

impl<T> Default for Column<T> {
    fn default() -> Self {
        Vec::new().into()
    }
}

impl<T: Pod> Clone for Column<T> {
    /// A long column has its copy in a file, too.
    fn clone(&self) -> Self {
        let folder = self.folder.clone();
        let is_long = size_of_val(&**self) >= Self::MOST_BYTES;
        let file = || GrowingBytes::in_folder(folder.as_deref(), bytemuck::cast_slice(self)).ok();
        let items = match is_long.then(file).flatten() {
            Some(bytes) => Items::InFile(bytes, PhantomData),
            None => Items::InMemory(self.to_vec()),
        };
        Self { folder, items }
    }
}

impl<T: Pod + PartialEq> PartialEq for Column<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<T: Pod + fmt::Debug> fmt::Debug for Column<T> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        (**self).fmt(formatter)
    }
}

/// An item of a column, as a row of `N` numbers.
pub trait Row<const N: usize>: Sized {
    /// Type of the numbers in the file.
    type Number: AutoSerialize + Pod;
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
        if x.is_nan() {
            return Some(unknown_pose());
        }
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), f64::MIN_POSITIVE);
        let translation = Translation3::new(x, y, z);
        Some(Self::from_parts(translation, rotation.unwrap_or_default()))
    }
}

/// A pose that is not known, such as the true one of a frame without a truth: all its components are NaN.
pub fn unknown_pose() -> Pose3 {
    let rotation = Quaternion::new(f64::NAN, f64::NAN, f64::NAN, f64::NAN);
    let translation = Translation3::new(f64::NAN, f64::NAN, f64::NAN);
    Pose3::from_parts(translation, UnitQuaternion::new_unchecked(rotation))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_column_is_the_same_in_a_file_and_takes_no_memory_of_its_own() {
        let folder = tempfile::tempdir().unwrap();
        let mut column = Column::in_folder(folder.path());
        let pose = |k: u32| Pose2::new([f64::from(k), 0.5].into(), 0.1);
        let all: Vec<Pose2> = (0..10_000).map(pose).collect();
        all.iter().for_each(|&pose| column.push(pose));
        assert!(matches!(column.items, Items::InFile(..)));
        assert_eq!(*column, *all);
        column[7] = pose(70);
        column.push(pose(3));
        assert_eq!((column[7], column[10_000]), (pose(70), pose(3)));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        let copy = column.clone();
        assert!(matches!(copy.items, Items::InFile(..)));
        column[7] = pose(7);
        assert_eq!(copy[7], pose(70));
        assert_ne!(copy, column);
    }
}
