//! Descriptors of panoramas: how far away the surroundings are in each sector of azimuth, in 48 bytes.
//!
//! A turn shifts the sectors, so that a scan is compared with a descriptor at every shift, as with a panorama, but at
//! a hundredth of the cost:
//!
//! ```text
//! descriptor(s) = mean over the pixels of a sector of log(range), 1 to 120 m
//! difference    = min over the shifts of the mean over the sectors of min(|descriptor − scan|, limit)
//! ```

use bytemuck::{Pod, Zeroable};

use super::scan_panorama::{NOTHING, ScanPanorama, metres_of};

/// Sectors of a turn.
const SECTORS: usize = 45;

/// Descriptor of a panorama.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct PlaceDescriptor {
    /// Logarithms of ranges, see [`level_of`].
    sectors: [u8; SECTORS],
    unused: [u8; 3],
}

/// Descriptor of a scan, twice in a row, so that a shift is a slice.
pub(crate) struct ScanDescriptor {
    sectors: [u8; 2 * SECTORS],
    /// All bits where the scan has returns.
    is_known: [u8; 2 * SECTORS],
    known: u32,
}

impl PlaceDescriptor {
    /// Describes a panorama, row-major, of some columns.
    pub fn of(panorama: &[u16], width: usize) -> Self {
        let sums = sectors_of(panorama.chunks(width), width);
        Self {
            sectors: sums.map(|(sum, count, _)| (sum / count.max(1.0)).round() as u8),
            unused: [0; 3],
        }
    }
}

impl ScanDescriptor {
    /// Describes a scan; sectors with few returns are unknown.
    pub fn of(scan: &ScanPanorama) -> Self {
        /// Least share of the pixels with a return.
        const LEAST: f32 = 0.25;
        // The first of each two rows that are the same.
        let rows = scan
            .ranges
            .chunks(2 * scan.width)
            .map(|row| &row[..scan.width]);
        let sums = sectors_of(rows, scan.width);
        let of = |sector: usize| {
            let (sum, count, all) = sums[sector % SECTORS];
            let is_known = count >= LEAST * all && count > 0.0;
            if is_known {
                ((sum / count).round() as u8, u8::MAX)
            } else {
                (0, 0)
            }
        };
        let is_known: [u8; 2 * SECTORS] = std::array::from_fn(|sector| of(sector).1);
        Self {
            sectors: std::array::from_fn(|sector| of(sector).0),
            is_known,
            known: is_known[..SECTORS]
                .iter()
                .map(|&bits| u32::from(bits & 1))
                .sum(),
        }
    }

    /// Mean difference in the known sectors at the shift at which it is least (unitless).
    pub fn difference(&self, place: &PlaceDescriptor) -> f32 {
        /// Larger differences, as those of traffic, are all the same.
        const LIMIT: u8 = 60;
        let at = |shift: usize| -> u32 {
            let sectors = &self.sectors[shift..][..SECTORS];
            let is_known = &self.is_known[shift..][..SECTORS];
            let compared = place.sectors.iter().zip(sectors).zip(is_known);
            compared
                .map(|((a, b), known)| u32::from(a.abs_diff(*b).min(LIMIT) & known))
                .sum()
        };
        let least = (0..SECTORS).map(at).min().unwrap_or(0);
        least as f32 / self.known.max(1) as f32
    }
}

/// Per sector the sum of the levels of its returns, their number and that of all pixels. Pixels of a panorama without a
/// surface count as far away.
fn sectors_of<'a>(
    rows: impl Iterator<Item = &'a [u16]>,
    width: usize,
) -> [(f32, f32, f32); SECTORS] {
    let mut sums = [(0.0, 0.0, 0.0); SECTORS];
    for row in rows {
        for (column, &range) in row.iter().enumerate() {
            let (sum, count, all) = &mut sums[column * SECTORS / width];
            *all += 1.0;
            if range != NOTHING {
                *sum += level_of(metres_of(range));
                *count += 1.0;
            }
        }
    }
    sums
}

/// 250 times the logarithm of a range to base 120, from 0 at 1 m to 250 at 120 m.
fn level_of(range_m: f32) -> f32 {
    const FARTHEST_M: f32 = 120.0;
    250.0 * range_m.clamp(1.0, FARTHEST_M).ln() / FARTHEST_M.ln()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::places::scan_panorama::steps_of;

    /// Walls of a yard around a place, six rows of 180 columns.
    fn yard(phase: f32) -> Vec<u16> {
        let row = (0..180_u16).map(|column| {
            let turns = f32::from(column) / 180.0 + phase;
            let range_m = 20.0 + 12.0 * (turns * 19.0).sin() + 5.0 * (turns * 44.0).cos();
            steps_of(range_m)
        });
        let row: Vec<u16> = row.collect();
        row.repeat(6)
    }

    /// The scan of a panorama after a turn by some columns to the left, without some returns.
    fn scan(panorama: &[u16], turn: usize, is_lost: impl Fn(usize) -> bool) -> ScanPanorama {
        let row = |row: &[u16]| {
            let pixel = |column: usize| {
                if is_lost(column) {
                    NOTHING
                } else {
                    row[(column + 180 - turn) % 180]
                }
            };
            let pixels: Vec<u16> = (0..180).map(pixel).collect();
            pixels.repeat(2)
        };
        ScanPanorama {
            width: 180,
            ranges: panorama.chunks(180).flat_map(row).collect(),
        }
    }

    #[test]
    fn a_turned_scan_differs_least_from_its_own_place_also_with_a_third_of_it_hidden() {
        let (here, elsewhere) = (yard(0.0), yard(0.7));
        let descriptors = [&here, &elsewhere].map(|place| PlaceDescriptor::of(place, 180));
        for turn in [0, 4, 88, 176] {
            let whole = ScanDescriptor::of(&scan(&here, turn, |_| false));
            assert_eq!(whole.difference(&descriptors[0]), 0.0, "{turn}");
            let hidden = ScanDescriptor::of(&scan(&here, turn, |column| column < 60));
            assert_eq!(hidden.difference(&descriptors[0]), 0.0, "{turn}");
            assert!(whole.difference(&descriptors[1]) > 3.0);
        }
    }

    #[test]
    fn a_scan_without_returns_differs_from_nothing() {
        let nothing = ScanDescriptor::of(&scan(&yard(0.0), 0, |_| true));
        assert_eq!(
            nothing.difference(&PlaceDescriptor::of(&yard(0.3), 180)),
            0.0
        );
    }
}
