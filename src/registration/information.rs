//! Linearized residuals, and what they show of the horizontal position.

use nalgebra::{Matrix2, Matrix6, Vector2, Vector6};

/// The linearized residual of one beam.
pub(super) struct Residual {
    /// Number of the beam among those that are registered.
    pub beam: usize,
    /// Distance to the plane of the surface [m].
    pub value_m: f64,
    /// By (x, y, z, roll, pitch, yaw) in the lidar frame.
    pub jacobian: Vector6<f64>,
    /// Sector of the azimuth.
    pub sector: usize,
}

/// What the scan shows of the horizontal position, without what the noise of the normals seems to show.
pub(super) struct Horizontal {
    /// Directions in the lidar frame.
    directions: Matrix2<f64>,
    /// Information on each direction while all other components are estimated, too.
    found: Vector2<f64>,
    /// The part of it that is not noise, positive.
    kept: Vector2<f64>,
}

impl Horizontal {
    /// Splits the information of residuals; `noise` is the part of each direction that is not information. `None` if it is
    /// singular.
    pub fn new(information: &Matrix6<f64>, noise: f64) -> Option<Self> {
        /// Share of its information that a direction keeps at least, so that the matrix stays positive definite.
        const LEAST: f64 = 1e-3;
        let covariance = information.try_inverse()?;
        let horizontal = covariance.fixed_view::<2, 2>(0, 0).into_owned();
        let eigen = horizontal.try_inverse()?.symmetric_eigen();
        let kept = |found: f64| (found - noise).max(LEAST * found);
        Some(Self {
            directions: eigen.eigenvectors,
            found: eigen.eigenvalues,
            kept: eigen.eigenvalues.map(kept),
        })
    }

    /// The information without that of the noise.
    pub fn corrected(&self, information: &Matrix6<f64>) -> Matrix6<f64> {
        let noise = Matrix2::from_diagonal(&(self.found - self.kept));
        let mut corrected = *information;
        let mut part = corrected.fixed_view_mut::<2, 2>(0, 0);
        part -= self.directions * noise * self.directions.transpose();
        corrected
    }

    /// A step without the directions of which only noise is known (Zhang, Kaess and Singh, *On Degeneracy of
    /// Optimization-based State Estimation Problems*, 2016).
    pub fn determined(&self, mut step: Vector6<f64>) -> Vector6<f64> {
        let shares = Matrix2::from_diagonal(&self.kept.component_div(&self.found));
        let mut part = step.fixed_rows_mut::<2>(0);
        let moved = self.directions * shares * self.directions.transpose() * &part;
        part.copy_from(&moved);
        step
    }
}
