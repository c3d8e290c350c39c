//! A ray alone goes through the hierarchy of wide nodes: eight boxes at once, then the triangles
//! of a leaf at once.
//!
//! Where neighbouring rays are far from each other, a packet opens the boxes of all of them; a
//! ray alone opens its own. The sums and products are those of [`super::packet`], and so are the
//! bits of what is met, unless the ray passes an edge within rounding.

use super::block::{Block, TRIANGLES};
use super::bvh::{Child, MAX_DEPTH};
use super::lanes::Lanes;
use super::packet::{FARTHER, inverse_of_one};
use super::triangle::{meet, minus, spread};
use super::wide::{CHILDREN, WideBvh, WideNode};
use super::{NEAREST_M, Reach};
use crate::geometry::Vec3;

/// So many children can wait: all but one of each node on the way down.
const MOST_WAITING: usize = (CHILDREN - 1) * MAX_DEPTH + CHILDREN;

/// A ray and what it met so far.
#[derive(Clone, Copy)]
pub(super) struct LoneRay {
    direction: [f32; 3],
    inverse: [f32; 3],
    /// Per axis, the side of a box that it enters through, and the side that it leaves through.
    sides: [[usize; 2]; 3],
    /// Surfaces nearer than this are not met [m].
    from_m: f32,
    /// How far there is still something to find [m].
    until_m: f32,
    /// See [`Reach::enough_m`].
    enough_m: f32,
    /// The nearest hit so far [m].
    pub range_m: f32,
}

impl LoneRay {
    #[inline(always)]
    pub fn new(direction: Vec3, reach: Reach) -> Self {
        let direction = direction.to_array();
        let inverse = direction.map(inverse_of_one);
        let side_of = |axis: usize| {
            if inverse[axis] < 0.0 {
                [axis + 3, axis]
            } else {
                [axis, axis + 3]
            }
        };
        Self {
            direction,
            inverse,
            sides: [side_of(0), side_of(1), side_of(2)],
            from_m: 0.0,
            until_m: reach.until_m,
            enough_m: reach.enough_m,
            range_m: f32::INFINITY,
        }
    }

    /// The same ray before anything was met, from a range on.
    #[inline(always)]
    pub fn between(self, from_m: f32, until_m: f32) -> Self {
        Self {
            from_m,
            until_m,
            ..self
        }
    }

    /// From where on each child is entered, and a bit for each that is.
    #[inline(always)]
    fn enters_children<L: Lanes<CHILDREN>>(
        &self,
        origin: [L; 3],
        inverse: [L; 3],
        node: &WideNode,
    ) -> (L, u32) {
        let mut near = L::splat(self.from_m);
        let mut far = L::splat(self.until_m);
        for axis in 0..3 {
            let [first, last] = self.sides[axis];
            let first = L::load(&node.bounds[first]).minus(origin[axis]);
            let last = L::load(&node.bounds[last]).minus(origin[axis]);
            near = near.or_more(first.times(inverse[axis]));
            far = far.or_less(last.times(inverse[axis]));
        }
        (near, near.at_most(far.times(L::splat(FARTHER))))
    }

    /// Takes the hit of a block that is nearer than what was known, as
    /// [`super::packet::Packet::meet`] does.
    #[inline(always)]
    pub fn meet<L: Lanes<TRIANGLES>>(&mut self, origin: Vec3, block: &Block) {
        let origin = spread(origin.to_array());
        let corners = block
            .corners()
            .map(|corner| minus(corner.map(|axis| L::load(&axis)), origin));
        let Some((mut inside, range_m)) = meet(spread(self.direction), corners) else {
            return;
        };
        let range_m = range_m.to_array();
        while inside != 0 {
            let range_m = range_m[inside.trailing_zeros() as usize % TRIANGLES];
            inside &= inside - 1;
            if range_m < self.until_m && range_m > NEAREST_M && range_m >= self.from_m {
                self.range_m = range_m;
                self.until_m = if range_m < self.enough_m {
                    0.0
                } else {
                    range_m
                };
            }
        }
    }
}

/// A child that waits for its turn.
#[derive(Clone, Copy)]
struct Waiting {
    child: Child,
    /// The ray does not enter it before [m].
    near_m: f32,
}

/// Memory of a walk.
pub(super) struct WaitingRoom {
    waiting: [Waiting; MOST_WAITING],
    count: usize,
}

impl WaitingRoom {
    pub fn new() -> Self {
        let nobody = Waiting {
            child: Child::leaf(0),
            near_m: 0.0,
        };
        Self {
            waiting: [nobody; MOST_WAITING],
            count: 0,
        }
    }

    #[inline(always)]
    fn push(&mut self, new: Waiting) {
        self.waiting[self.count] = new;
        self.count += 1;
    }

    /// The next one that can still hold something to find.
    #[inline(always)]
    fn pop(&mut self, ray: &LoneRay) -> Option<Child> {
        while self.count > 0 {
            self.count -= 1;
            let next = self.waiting[self.count];
            if next.near_m <= ray.until_m * FARTHER {
                return Some(next.child);
            }
        }
        None
    }

    /// Adds one behind those who came after `first` and are nearer.
    #[inline(always)]
    fn push_in_order(&mut self, new: Waiting, first: usize) {
        let mut place = self.count;
        self.push(new);
        while place > first && self.waiting[place - 1].near_m < new.near_m {
            self.waiting[place] = self.waiting[place - 1];
            place -= 1;
        }
        self.waiting[place] = new;
    }
}

/// The way of a ray through a hierarchy, from leaf to leaf, near ones first.
pub(super) struct LoneWalk<'a, L> {
    bvh: &'a WideBvh,
    /// In the frame of the hierarchy.
    origin: [L; 3],
    inverse: [L; 3],
    room: &'a mut WaitingRoom,
}

impl<'a, L: Lanes<CHILDREN>> LoneWalk<'a, L> {
    #[inline(always)]
    pub fn new(ray: &LoneRay, bvh: &'a WideBvh, origin: Vec3, room: &'a mut WaitingRoom) -> Self {
        room.count = 0;
        if !bvh.nodes.is_empty() {
            room.push(Waiting {
                child: Child::node(0),
                near_m: 0.0,
            });
        }
        Self {
            bvh,
            origin: spread(origin.to_array()),
            inverse: spread(ray.inverse),
            room,
        }
    }

    /// The next leaf that the ray may find something in.
    #[inline(always)]
    pub fn next_leaf(&mut self, ray: &LoneRay) -> Option<usize> {
        while let Some(mut current) = self.room.pop(ray) {
            loop {
                if current.is_leaf() {
                    return Some(current.index());
                }
                let Some(nearest) = self.open(ray, current.index()) else {
                    break;
                };
                current = nearest;
            }
        }
        None
    }

    /// The nearest child that the ray enters; the others wait.
    #[inline(always)]
    fn open(&mut self, ray: &LoneRay, index: usize) -> Option<Child> {
        let node = &self.bvh.nodes[index];
        let (near, mut entered) = ray.enters_children(self.origin, self.inverse, node);
        if entered == 0 {
            return None;
        }
        let mut nearest = entered.trailing_zeros() as usize % CHILDREN;
        entered &= entered - 1;
        if entered == 0 {
            return Some(node.children[nearest]);
        }
        let near = near.to_array();
        let first = self.room.count;
        while entered != 0 {
            let mut other = entered.trailing_zeros() as usize % CHILDREN;
            entered &= entered - 1;
            if near[other] < near[nearest] {
                std::mem::swap(&mut other, &mut nearest);
            }
            let other = Waiting {
                child: node.children[other],
                near_m: near[other],
            };
            self.room.push_in_order(other, first);
        }
        Some(node.children[nearest])
    }
}
