//! Colors: fixed ones of trajectories, the same in every picture, and colormaps of numbers.
//!
//! The palette is that of Okabe and Ito (2008), which people with color blindness can distinguish.
//! Magnitudes have the colormap viridis (van der Walt and Smith 2015), whose lightness increases
//! uniformly, differences ColorBrewer's red and blue (Brewer 1994), white at zero.

use crate::localization::State;

/// Red, green and blue, 0 to 255.
pub type Rgb = [u8; 3];

/// Color of the ground truth.
pub const TRUTH: Rgb = [30, 30, 30];
/// Color of the estimates of the filter.
pub const MCL: Rgb = [213, 94, 0];
/// Color of the refined trajectory.
pub const REFINED: Rgb = [0, 114, 178];
/// Color of odometry.
pub const ODOMETRY: Rgb = [204, 121, 167];
/// Colors of the states of the filter.
pub const STATES: [(State, Rgb); 3] = [
    (State::Tracking, [0, 158, 115]),
    (State::Searching, [230, 159, 0]),
    (State::Lost, [200, 30, 30]),
];
/// Colors of further series, in this order.
pub const SERIES: [Rgb; 6] = [
    REFINED,
    MCL,
    [0, 158, 115],
    ODOMETRY,
    [86, 180, 233],
    [230, 159, 0],
];
/// Color of unknown values: a pixel without a return, a vertex without a value.
pub const MISSING: Rgb = [150, 150, 150];

pub(crate) const WHITE: Rgb = [255, 255, 255];
pub(crate) const INK: Rgb = [40, 40, 40];
pub(crate) const GRID: Rgb = [226, 226, 226];
pub(crate) const FRAME: Rgb = [120, 120, 120];

/// Mapping of numbers to colors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Colormap {
    /// Dark to light, for magnitudes.
    Viridis,
    /// Blue over white to red, for differences.
    Diverging,
}

const VIRIDIS: [u32; 10] = [
    0x440154, 0x482878, 0x3e4a89, 0x31688e, 0x26828e, 0x1f9e89, 0x35b779, 0x6dcd59, 0xb4de2c,
    0xfde725,
];

const DIVERGING: [u32; 9] = [
    0x2166ac, 0x4393c3, 0x92c5de, 0xd1e5f0, 0xf7f7f7, 0xfddbc7, 0xf4a582, 0xd6604d, 0xb2182b,
];

impl Colormap {
    /// Color of a share, clamped to 0 to 1; [`MISSING`] for NaN.
    pub fn at(self, share: f64) -> Rgb {
        let anchors: &[u32] = match self {
            Self::Viridis => &VIRIDIS,
            Self::Diverging => &DIVERGING,
        };
        if share.is_nan() {
            return MISSING;
        }
        let last = anchors.len() - 1;
        let place = share.clamp(0.0, 1.0) * last as f64;
        let below = (place as usize).min(last - 1);
        let [from, to] = [below, below + 1].map(|place| rgb(anchors[place]));
        blend(from, to, place - below as f64)
    }

    /// Color of each confidence, 0 to 1.
    pub fn colors(self, confidences: &[f32]) -> Vec<Rgb> {
        let color = |&confidence: &f32| self.at(f64::from(confidence));
        confidences.iter().map(color).collect()
    }
}

/// The color of a number 0xRRGGBB.
fn rgb(number: u32) -> Rgb {
    let [_, red, green, blue] = number.to_be_bytes();
    [red, green, blue]
}

/// Linear interpolation between two colors.
pub(crate) fn blend(from: Rgb, to: Rgb, share: f64) -> Rgb {
    std::array::from_fn(|channel| {
        let (from, to) = (f64::from(from[channel]), f64::from(to[channel]));
        (from + share * (to - from)).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lightness(color: Rgb) -> f64 {
        0.2126 * f64::from(color[0]) + 0.7152 * f64::from(color[1]) + 0.0722 * f64::from(color[2])
    }

    #[test]
    fn the_lightness_of_viridis_increases_monotonically() {
        let lights: Vec<f64> = (0..=100)
            .map(|percent| lightness(Colormap::Viridis.at(f64::from(percent) / 100.0)))
            .collect();
        assert!(lights.windows(2).all(|pair| pair[1] >= pair[0]));
    }

    #[test]
    fn differences_are_white_at_zero_and_equally_dark_on_both_sides() {
        let middle = lightness(Colormap::Diverging.at(0.5));
        assert!(middle > 240.0);
        for share in [0.0, 0.2, 0.4] {
            let (low, high) = (
                lightness(Colormap::Diverging.at(share)),
                lightness(Colormap::Diverging.at(1.0 - share)),
            );
            assert!((low - high).abs() < 45.0 && low < middle && high < middle);
        }
    }

    #[test]
    fn nan_has_the_color_of_missing_values() {
        assert_eq!(Colormap::Viridis.at(f64::NAN), MISSING);
        assert_eq!(Colormap::Viridis.at(-3.0), rgb(VIRIDIS[0]));
        assert_eq!(Colormap::Viridis.at(f64::INFINITY), rgb(VIRIDIS[9]));
    }
}
