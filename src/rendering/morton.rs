//! Bits of Morton codes, which number cells along a Z-order curve (Morton 1966).

/// Puts a zero before each of the lower 16 bits.
pub(super) fn spread(bits: u32) -> u32 {
    let bits = bits & 0xffff;
    let bits = (bits | bits << 8) & 0x00ff_00ff;
    let bits = (bits | bits << 4) & 0x0f0f_0f0f;
    let bits = (bits | bits << 2) & 0x3333_3333;
    (bits | bits << 1) & 0x5555_5555
}

/// Puts two zeros before each of the lower 10 bits.
pub(super) fn spread_by_three(bits: u32) -> u32 {
    let bits = bits & 0x3ff;
    let bits = (bits | bits << 16) & 0x0300_00ff;
    let bits = (bits | bits << 8) & 0x0300_f00f;
    let bits = (bits | bits << 4) & 0x030c_30c3;
    (bits | bits << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_bits_leave_room_for_the_other_axes() {
        assert_eq!(spread(0b1011), 0b100_0101);
        assert_eq!(spread(0xffff) & spread(0xffff) << 1, 0);
        let all = spread_by_three(0x3ff);
        assert_eq!(all & all << 1 | all & all << 2, 0);
        assert_eq!(all.count_ones(), 10);
    }
}
