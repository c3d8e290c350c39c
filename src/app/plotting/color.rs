//! Colours: of trajectories, fixed so that every picture means the same by them, and of scalars.
//!
//! The palette is that of Okabe and Ito (2008), which people with colour-blindness can tell
//! apart. Scalars are shown by viridis (van der Walt and Smith, 2015), whose lightness grows
//! evenly, differences by ColorBrewer's red and blue (Brewer 1994), white at zero.

/// Red, green, blue.
pub type Rgb = [u8; 3];

/// The ground truth.
pub const TRUTH: Rgb = [30, 30, 30];
/// The filter's estimate.
pub const MCL: Rgb = [213, 94, 0];
/// The refined trajectory.
pub const REFINED: Rgb = [0, 114, 178];
/// Odometry alone.
pub const ODOMETRY: Rgb = [204, 121, 167];
/// Further series, in this order.
pub const SERIES: [Rgb; 6] = [
    REFINED,
    MCL,
    [0, 158, 115],
    ODOMETRY,
    [86, 180, 233],
    [230, 159, 0],
];
/// Where nothing is known: a pixel without a return, a vertex without a value.
pub const MISSING: Rgb = [150, 150, 150];

pub(super) const WHITE: Rgb = [255, 255, 255];
pub(super) const INK: Rgb = [40, 40, 40];
pub(super) const GRID: Rgb = [226, 226, 226];
pub(super) const FRAME: Rgb = [120, 120, 120];

/// Which colours stand for a scalar.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Colormap {
    /// Dark to light, for magnitudes.
    Viridis,
    /// Blue over white to red, for differences.
    Diverging,
}

const VIRIDIS: [Rgb; 10] = [
    [68, 1, 84],
    [72, 40, 120],
    [62, 74, 137],
    [49, 104, 142],
    [38, 130, 142],
    [31, 158, 137],
    [53, 183, 121],
    [109, 205, 89],
    [180, 222, 44],
    [253, 231, 37],
];

const DIVERGING: [Rgb; 9] = [
    [33, 102, 172],
    [67, 147, 195],
    [146, 197, 222],
    [209, 229, 240],
    [247, 247, 247],
    [253, 219, 199],
    [244, 165, 130],
    [214, 96, 77],
    [178, 24, 43],
];

impl Colormap {
    /// The colour of a share, 0 to 1; beyond, that of the end. [`MISSING`] where it is NaN.
    pub fn at(self, share: f64) -> Rgb {
        let anchors: &[Rgb] = match self {
            Self::Viridis => &VIRIDIS,
            Self::Diverging => &DIVERGING,
        };
        if share.is_nan() {
            return MISSING;
        }
        let last = anchors.len() - 1;
        let place = share.clamp(0.0, 1.0) * last as f64;
        let below = (place as usize).min(last - 1);
        blend(anchors[below], anchors[below + 1], place - below as f64)
    }
}

/// The colour at a share of the way from one to another.
pub(super) fn blend(from: Rgb, to: Rgb, share: f64) -> Rgb {
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
    fn viridis_grows_lighter_all_the_way() {
        let lights: Vec<f64> = (0..=100)
            .map(|percent| lightness(Colormap::Viridis.at(f64::from(percent) / 100.0)))
            .collect();
        assert!(lights.windows(2).all(|pair| pair[1] >= pair[0]));
    }

    #[test]
    fn differences_are_white_at_zero_and_as_dark_on_both_sides() {
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
    fn what_is_not_a_number_has_the_colour_of_nothing() {
        assert_eq!(Colormap::Viridis.at(f64::NAN), MISSING);
        assert_eq!(Colormap::Viridis.at(-3.0), VIRIDIS[0]);
        assert_eq!(Colormap::Viridis.at(f64::INFINITY), VIRIDIS[9]);
    }
}
