//! SemanticKITTI classes that occur in the simulated world (Behley et al., ICCV 2019).

/// Passenger cars that stand.
pub const CAR: u16 = 10;
/// Trucks and delivery vans that stand.
pub const TRUCK: u16 = 18;
/// Carriageway.
pub const ROAD: u16 = 40;
/// Parking bays and squares.
pub const PARKING: u16 = 44;
/// Pavement beside the carriageway, with its kerb.
pub const SIDEWALK: u16 = 48;
/// Houses.
pub const BUILDING: u16 = 50;
/// Garden walls and fences.
pub const FENCE: u16 = 51;
/// Monuments, benches, transformer boxes.
pub const OTHER_STRUCTURE: u16 = 52;
/// Crowns of trees, bushes, hedges.
pub const VEGETATION: u16 = 70;
/// Stems of trees.
pub const TRUNK: u16 = 71;
/// Gardens and grass.
pub const TERRAIN: u16 = 72;
/// Street lamps and posts.
pub const POLE: u16 = 80;
/// Plates of traffic signs.
pub const TRAFFIC_SIGN: u16 = 81;
/// Bins and the like.
pub const OTHER_OBJECT: u16 = 99;
/// Passenger cars that drive.
pub const MOVING_CAR: u16 = 252;
/// Cyclists that ride.
pub const MOVING_BICYCLIST: u16 = 253;
/// People that walk.
pub const MOVING_PERSON: u16 = 254;
/// Trucks and delivery vans that drive.
pub const MOVING_TRUCK: u16 = 258;

/// Whether points of a class are ground, as the ground segmentation benchmark of Patchwork++ counts them.
pub fn is_ground(class: u16) -> bool {
    matches!(class, ROAD | PARKING | SIDEWALK | 49 | 60 | TERRAIN)
}

/// Whether things of a class move while the sensor looks at them.
pub fn is_moving(class: u16) -> bool {
    (252..=259).contains(&class)
}
