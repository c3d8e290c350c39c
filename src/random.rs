//! Random numbers that follow from a seed alone.
//!
//! A seed has 2⁶⁴ independent streams (ChaCha8, Bernstein 2008): whoever draws, for example the
//! filter in frame 7, takes a stream of its own, so that the numbers are the same whatever the
//! others draw and however many threads there are.

use rand::SeedableRng as _;
pub use rand_chacha::ChaCha8Rng as Generator;

/// Returns the generator of a stream of a seed, at its start.
pub fn stream(seed: u64, stream: u64) -> Generator {
    let mut rng = Generator::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}
