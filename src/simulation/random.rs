//! Counter-based random streams: the numbers of a stream depend on the seed, its purpose and its
//! index alone, never on the thread that draws or on what was drawn elsewhere.

use crate::random::Generator;

/// Purpose of random numbers; each has its own streams.
#[derive(Clone, Copy, Debug)]
#[repr(u8)]
pub(super) enum Purpose {
    Layout = 1,
    House = 2,
    Furniture = 3,
    Plant = 4,
    ParkedCar = 5,
    Undulation = 6,
    Drive = 7,
    Traffic = 8,
    Scan = 9,
    Odometry = 10,
    Square = 11,
    Change = 12,
    GivenPoses = 13,
    Imu = 14,
    Gnss = 15,
}

/// Stream number `index` of a purpose: the only source of generators in this module.
pub(super) fn stream(seed: u64, purpose: Purpose, index: u64) -> Generator {
    crate::random::stream(seed, ((purpose as u64) << 56) | index)
}
