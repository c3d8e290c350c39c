//! Where a triangle is in a scene.

/// A leaf among those of all tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Leaf {
    pub tile: u32,
    pub index: u32,
}

/// A triangle among those of a leaf.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Place {
    pub leaf: Leaf,
    pub lane: u32,
}

impl Place {
    /// No triangle.
    pub const NONE: Self = Self {
        leaf: Leaf {
            tile: u32::MAX,
            index: u32::MAX,
        },
        lane: 0,
    };

    #[inline(always)]
    pub fn new(leaf: Leaf, lane: usize) -> Self {
        let lane = lane as u32;
        Self { leaf, lane }
    }
}
