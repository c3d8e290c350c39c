//! SemanticKITTI classes that occur in the simulated world (Behley et al., ICCV 2019).

/// Returns that no surface gave.
pub const OUTLIER: u16 = 1;
/// Parked passenger cars.
pub const CAR: u16 = 10;
/// Parked trucks and delivery vans.
pub const TRUCK: u16 = 18;
/// Carriageway.
pub const ROAD: u16 = 40;
/// Parking bays and squares.
pub const PARKING: u16 = 44;
/// Sidewalks with their kerbs.
pub const SIDEWALK: u16 = 48;
/// Buildings.
pub const BUILDING: u16 = 50;
/// Garden walls and fences.
pub const FENCE: u16 = 51;
/// Monuments, benches and transformer boxes.
pub const OTHER_STRUCTURE: u16 = 52;
/// Crowns of trees, bushes and hedges.
pub const VEGETATION: u16 = 70;
/// Tree trunks.
pub const TRUNK: u16 = 71;
/// Gardens and grass.
pub const TERRAIN: u16 = 72;
/// Street lamps and posts.
pub const POLE: u16 = 80;
/// Traffic sign plates.
pub const TRAFFIC_SIGN: u16 = 81;
/// Bins and other objects.
pub const OTHER_OBJECT: u16 = 99;
/// Moving passenger cars.
pub const MOVING_CAR: u16 = 252;
/// Moving cyclists.
pub const MOVING_BICYCLIST: u16 = 253;
/// Walking people.
pub const MOVING_PERSON: u16 = 254;
/// Moving trucks and delivery vans.
pub const MOVING_TRUCK: u16 = 258;
