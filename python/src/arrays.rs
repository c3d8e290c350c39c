//! Conversions between NumPy's arrays and the types of the library.

use std::borrow::Cow;

use fpmcl::geometry::{Pose2, Pose3, pose2_from_pose3, pose3_from_pose2};
use glam::Vec3;
use nalgebra::{Matrix3, Matrix4, Rotation3, UnitQuaternion, Vector2, Vector3};
use numpy::ndarray::{Array2, Array3, ArrayView};
use numpy::{
    AllowTypeChange, Element, IntoPyArray as _, PyArray1, PyArray2, PyArray3, PyArrayDyn,
    PyArrayLike1, PyArrayLike2, PyArrayLikeDyn, PyUntypedArrayMethods as _,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// Numbers of an argument: the array itself if it is of the type, else a converted one.
pub type Numbers1<'py, T> = PyArrayLike1<'py, T, AllowTypeChange>;
/// The same in rows and columns.
pub type Numbers2<'py, T> = PyArrayLike2<'py, T, AllowTypeChange>;
/// The same of any shape.
pub type Numbers<'py, T> = PyArrayLikeDyn<'py, T, AllowTypeChange>;

/// Points or directions of an array of shape (N, 3): those of the array itself if its rows are contiguous.
pub fn vectors<'a>(name: &str, array: &'a Numbers2<'_, f32>) -> PyResult<Cow<'a, [Vec3]>> {
    if array.shape()[1] != 3 {
        return Err(wrong_shape(name, array.shape(), "(N, 3)"));
    }
    let rows = array.as_array();
    Ok(match rows.to_slice() {
        Some(numbers) => Cow::Borrowed(bytemuck::cast_slice(numbers)),
        None => {
            let vector = |row: ArrayView<'_, f32, _>| Vec3::new(row[0], row[1], row[2]);
            Cow::Owned(rows.rows().into_iter().map(vector).collect())
        }
    })
}

/// A pose of an array of shape (4, 4).
pub fn pose(name: &str, array: &Numbers<'_, f64>) -> PyResult<Pose3> {
    match poses(name, array)?.as_slice() {
        [pose] if array.ndim() == 2 => Ok(*pose),
        _ => Err(wrong_shape(name, array.shape(), "(4, 4)")),
    }
}

/// Poses of an array of shape (N, 4, 4); one of shape (4, 4) is a single pose.
pub fn poses(name: &str, array: &Numbers<'_, f64>) -> PyResult<Vec<Pose3>> {
    let shape = array.shape();
    if !matches!(shape, [4, 4] | [_, 4, 4]) {
        return Err(wrong_shape(name, shape, "(N, 4, 4)"));
    }
    let numbers: Vec<f64> = array.as_array().iter().copied().collect();
    let matrices = numbers.chunks(16).map(Matrix4::from_row_slice);
    matrices
        .map(|matrix| {
            rigid(&matrix).ok_or_else(|| {
                let rows = matrix.row_iter().map(|row| row.iter().copied().collect());
                let rows: Vec<Vec<f64>> = rows.collect();
                PyValueError::new_err(format!(
                    "{name} is no rigid transform: {rows:?}; give a rotation and a translation with the last row 0, 0, 0, 1"
                ))
            })
        })
        .collect()
}

/// The pose of a matrix; `None` if it is no rotation and translation.
fn rigid(matrix: &Matrix4<f64>) -> Option<Pose3> {
    /// Largest deviation of a rotation in single precision (unitless).
    const TOLERANCE: f64 = 1e-5;
    let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
    let translation: Vector3<f64> = matrix.fixed_view::<3, 1>(0, 3).into();
    let is_rotation = (rotation.transpose() * rotation - Matrix3::identity()).amax() < TOLERANCE
        && rotation.determinant() > 0.0;
    let is_affine = matrix.row(3) == Matrix4::identity().row(3);
    let is_finite = translation.iter().all(|m| m.is_finite());
    let rotation = Rotation3::from_matrix_unchecked(rotation);
    (is_rotation && is_affine && is_finite).then(|| {
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        Pose3::from_parts(translation.into(), rotation)
    })
}

/// A pose in the plane of an array of shape (3,): x, y [m], heading [rad].
pub fn planar(name: &str, array: &Numbers<'_, f64>) -> PyResult<Pose2> {
    let numbers: Vec<f64> = array.as_array().iter().copied().collect();
    match numbers[..] {
        [x, y, heading_rad] if array.ndim() == 1 => Ok(Pose2::new(Vector2::new(x, y), heading_rad)),
        _ => Err(wrong_shape(name, array.shape(), "(3,) or (4, 4)")),
    }
}

/// Motions or poses in the plane, of an array of shape (N, 3) or (N, 4, 4).
pub fn all_planar(name: &str, array: &Numbers<'_, f64>) -> PyResult<Vec<Pose2>> {
    if let [_, 3] = array.shape() {
        let numbers: Vec<f64> = array.as_array().iter().copied().collect();
        let pose = |row: &[f64]| Pose2::new(Vector2::new(row[0], row[1]), row[2]);
        return Ok(numbers.chunks(3).map(pose).collect());
    }
    match array.ndim() {
        3 => Ok(poses(name, array)?.iter().map(pose2_from_pose3).collect()),
        _ => Err(wrong_shape(name, array.shape(), "(N, 3) or (N, 4, 4)")),
    }
}

/// A pose in space, whose height, roll and pitch are zero.
pub fn in_space(pose: &Pose2) -> Pose3 {
    pose3_from_pose2(pose, 0.0)
}

fn wrong_shape(name: &str, shape: &[usize], expected: &str) -> PyErr {
    let shape: Vec<String> = shape.iter().map(usize::to_string).collect();
    let shape = shape.join(", ");
    PyValueError::new_err(format!(
        "{name} has the shape ({shape}); it must be {expected}"
    ))
}

/// An array of shape (4, 4).
pub fn of_pose<'py>(py: Python<'py>, pose: &Pose3) -> Bound<'py, PyArray2<f64>> {
    let matrix = pose.to_homogeneous();
    Array2::from_shape_fn((4, 4), |index| matrix[index]).into_pyarray(py)
}

/// An array of shape (N, 4, 4).
pub fn of_poses<'py>(py: Python<'py>, poses: &[Pose3]) -> Bound<'py, PyArray3<f64>> {
    let matrices: Vec<Matrix4<f64>> = poses.iter().map(Pose3::to_homogeneous).collect();
    Array3::from_shape_fn((poses.len(), 4, 4), |(n, row, column)| {
        matrices[n][(row, column)]
    })
    .into_pyarray(py)
}

/// An array of shape (3,): x, y [m], heading [rad].
pub fn of_planar<'py>(py: Python<'py>, pose: &Pose2) -> Bound<'py, PyArray1<f64>> {
    PyArray1::from_slice(py, &numbers(pose))
}

/// An array of shape (N, 3).
pub fn of_all_planar<'py>(py: Python<'py>, poses: &[Pose2]) -> Bound<'py, PyArray2<f64>> {
    let rows: Vec<[f64; 3]> = poses.iter().map(numbers).collect();
    Array2::from(rows).into_pyarray(py)
}

fn numbers(pose: &Pose2) -> [f64; 3] {
    let t = pose.translation;
    [t.x, t.y, pose.rotation.angle()]
}

/// An array of shape (N, 3, 3).
pub fn of_matrices<'py>(py: Python<'py>, all: &[Matrix3<f64>]) -> Bound<'py, PyArray3<f64>> {
    let number = |(n, row, column): (usize, usize, usize)| all[n][(row, column)];
    Array3::from_shape_fn((all.len(), 3, 3), number).into_pyarray(py)
}

/// An array of shape (3, 3).
pub fn of_matrix<'py>(py: Python<'py>, matrix: &Matrix3<f64>) -> Bound<'py, PyArray2<f64>> {
    Array2::from_shape_fn((3, 3), |index| matrix[index]).into_pyarray(py)
}

/// A read-only array on the values of an immutable object, which it keeps alive; nothing is copied.
#[expect(unsafe_code, reason = "NumPy has no other way to share memory")]
pub fn view<'py, T: Element>(
    values: &[T],
    shape: &[usize],
    owner: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let values = ArrayView::from_shape(shape, values)
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    // SAFETY: `values` belong to a frozen class or to what it shares, which never changes them; the array keeps `owner`
    // alive, and nothing writes through it.
    let array = unsafe { PyArrayDyn::borrow_from_array(&values, owner.clone()) };
    // Not through an exclusive borrow, which fails while another thread reads a view of the same owner.
    array.call_method1("setflags", (false,))?;
    Ok(array)
}

/// The same for vectors, as an array of shape (N, 3).
pub fn view_of_vectors<'py>(
    vectors: &[Vec3],
    owner: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
    view(bytemuck::cast_slice(vectors), &[vectors.len(), 3], owner)
}
