//! Counter-based random streams: what a stream yields depends on the seed, its purpose and its
//! index alone, never on the thread that draws or on what was drawn elsewhere.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// What numbers are drawn for; each purpose has streams of its own.
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
}

/// The stream number `index` for a purpose. Generators are made by nobody else in this module.
pub(super) fn stream(seed: u64, purpose: Purpose, index: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(((purpose as u64) << 56) | index);
    rng
}
