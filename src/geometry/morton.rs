//! Morton codes: the interleaved bits of the three coordinates of a cell, x lowest (Morton 1966). Cells
//! sorted by code lie along a Z-order curve, and those of every octree node are contiguous.

/// The code of a cell, 21 bits per coordinate.
pub fn encode(cell: [u32; 3]) -> u64 {
    spread(cell[0]) | spread(cell[1]) << 1 | spread(cell[2]) << 2
}

/// The cell of a code; [`encode`] is the inverse.
pub fn decode(code: u64) -> [u32; 3] {
    [compact(code), compact(code >> 1), compact(code >> 2)]
}

fn spread(coordinate: u32) -> u64 {
    let mut bits = u64::from(coordinate) & 0x1f_ffff;
    bits = (bits | bits << 32) & 0x001f_0000_0000_ffff;
    bits = (bits | bits << 16) & 0x001f_0000_ff00_00ff;
    bits = (bits | bits << 8) & 0x100f_00f0_0f00_f00f;
    bits = (bits | bits << 4) & 0x10c3_0c30_c30c_30c3;
    (bits | bits << 2) & 0x1249_2492_4924_9249
}

fn compact(code: u64) -> u32 {
    let mut bits = code & 0x1249_2492_4924_9249;
    bits = (bits | bits >> 2) & 0x10c3_0c30_c30c_30c3;
    bits = (bits | bits >> 4) & 0x100f_00f0_0f00_f00f;
    bits = (bits | bits >> 8) & 0x001f_0000_ff00_00ff;
    bits = (bits | bits >> 16) & 0x001f_0000_0000_ffff;
    ((bits | bits >> 32) & 0x1f_ffff) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decoding_inverts_encoding() {
        for cell in [[0, 0, 0], [1, 2, 3], [4095, 17, 2048], [0x1f_ffff, 0, 5]] {
            assert_eq!(decode(encode(cell)), cell);
        }
    }

    #[test]
    fn the_parent_of_a_cell_is_its_code_without_the_last_three_bits() {
        assert_eq!(decode(encode([13, 6, 9]) >> 3), [6, 3, 4]);
    }
}
