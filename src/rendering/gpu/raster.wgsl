// Range images by drawing: every triangle is a rectangle of pixels that surely covers it, and
// every pixel of the rectangle casts its own centre ray.
//
// In spherical projection straight edges bend, triangles cross the seam behind the sensor, and
// those above or below it reach all around: the rectangle only has to be large enough, the ray
// decides. A triangle that crosses the seam is drawn on both sides, as two rectangles.
//
// `ray.wgsl` is prepended to this text. Keep in sync with `layout.rs`: `Atlas`,
// `VERTICES_PER_TRIANGLE`; and with `LidarModel::pixel_of` in `model.rs` of `lidar`.

const PI: f32 = 3.14159274;
const VERTICES_PER_RECTANGLE: u32 = 6u;
const VERTICES_PER_TRIANGLE: u32 = 12u;
// Error bound of `atan2` (WGSL allows 4096 units in the last place) [rad].
const SLACK_RAD: f32 = 0.002;
// A corner nearer than this to the vertical through the sensor has no azimuth [m].
const AXIS_M: f32 = 1.0e-4;

// Images side by side and one above the other in one texture.
struct Atlas {
    // Of one image [pixels].
    width: u32,
    height: u32,
    // Images side by side.
    columns: u32,
    unused: u32,
    // Of the texture [pixels].
    atlas_size: vec2f,
    fov_up_rad: f32,
    fov_rad: f32,
    // Surfaces at this range or farther are not drawn [m].
    far_m: f32,
    unused_0: u32,
    unused_1: u32,
    unused_2: u32,
}

@group(0) @binding(0) var<storage, read> triangles: array<Triangle>;
@group(0) @binding(1) var<uniform> atlas: Atlas;
@group(0) @binding(2) var<storage, read> poses: array<Pose>;
// Centre rays of the pixels, row by row.
@group(0) @binding(3) var<storage, read> directions: array<vec4f>;

struct Corner {
    @builtin(position) position: vec4f,
    @location(0) @interpolate(flat) triangle: u32,
    @location(1) @interpolate(flat) slot: u32,
}

// First and last column and row, inclusive; empty where the first comes after the last.
struct Rectangle {
    columns: vec2i,
    rows: vec2i,
}

const NOTHING: Rectangle = Rectangle(vec2i(1, 0), vec2i(1, 0));

fn point_in_lidar(pose: Pose, point: vec3f) -> vec3f {
    let p = from_origin(pose, point);
    return vec3f(dot(pose.x_axis.xyz, p), dot(pose.y_axis.xyz, p), dot(pose.z_axis.xyz, p));
}

fn elevation_of(p: vec3f) -> f32 {
    return atan2(p.z, max(length(p.xy), AXIS_M));
}

// Lowest and highest elevation along an edge; a straight edge bends up or down between its ends.
fn elevations_of_edge(p: vec3f, q: vec3f) -> vec2f {
    let ends = vec2f(elevation_of(p), elevation_of(q));
    let edge = q - p;
    // Whether the elevation rises when one walks from either end into the edge.
    let from_p = edge.z * dot(p, p) - p.z * dot(p, edge);
    let from_q = q.z * dot(q, edge) - edge.z * dot(q, q);
    let normal = cross(p, q);
    let apex = atan2(length(normal.xy), abs(normal.z));
    return vec2f(
        select(min(ends.x, ends.y), -apex, from_p < 0.0 && from_q < 0.0),
        select(max(ends.x, ends.y), apex, from_p > 0.0 && from_q > 0.0),
    );
}

fn wrapped(angle_rad: f32) -> f32 {
    return angle_rad - 2.0 * PI * round(angle_rad / (2.0 * PI));
}

// Pixels whose centres lie between two places, both in pixels.
fn centers_between(low: f32, high: f32) -> vec2i {
    return vec2i(i32(ceil(low - 0.5)), i32(floor(high - 0.5)));
}

fn rows_of(elevations: vec2f) -> vec2i {
    let rows_per_rad = f32(atlas.height) / atlas.fov_rad;
    let top = (atlas.fov_up_rad - elevations.y - SLACK_RAD) * rows_per_rad;
    let bottom = (atlas.fov_up_rad - elevations.x + SLACK_RAD) * rows_per_rad;
    let last = i32(atlas.height) - 1;
    // Clamped before they are rounded: far outside of the image they do not fit an integer.
    let rows = centers_between(max(top, -1.0), min(bottom, f32(atlas.height) + 1.0));
    return vec2i(max(rows.x, 0), min(rows.y, last));
}

// The rectangle of a triangle (lidar frame) in the image, or what is left of it beyond the seam.
fn rectangle_of(a: vec3f, b: vec3f, c: vec3f, beyond_seam: bool) -> Rectangle {
    let ab = elevations_of_edge(a, b);
    let bc = elevations_of_edge(b, c);
    let ca = elevations_of_edge(c, a);
    var elevations = vec2f(min(ab.x, min(bc.x, ca.x)), max(ab.y, max(bc.y, ca.y)));

    let azimuth = atan2(a.y, a.x);
    let to_b = wrapped(atan2(b.y, b.x) - azimuth);
    let to_c = wrapped(atan2(c.y, c.x) - azimuth);
    let left_rad = max(0.0, max(to_b, to_c));
    let right_rad = min(0.0, min(to_b, to_c));
    let to_axis = min(length(a.xy), min(length(b.xy), length(c.xy)));
    let last = i32(atlas.width) - 1;

    if left_rad - right_rad > PI - 4.0 * SLACK_RAD || to_axis <= AXIS_M {
        // The vertical through the sensor may pass through the triangle: it reaches all around,
        // and up or down to the pole.
        if min(a.z, min(b.z, c.z)) <= 0.0 {
            elevations.x = -0.5 * PI;
        }
        if max(a.z, max(b.z, c.z)) >= 0.0 {
            elevations.y = 0.5 * PI;
        }
        if beyond_seam {
            return NOTHING;
        }
        return Rectangle(vec2i(0, last), rows_of(elevations));
    }

    let columns_per_rad = 0.5 * f32(atlas.width) / PI;
    let columns = centers_between(
        (PI - azimuth - left_rad - SLACK_RAD) * columns_per_rad,
        (PI - azimuth - right_rad + SLACK_RAD) * columns_per_rad,
    );
    let rows = rows_of(elevations);
    if !beyond_seam {
        return Rectangle(vec2i(max(columns.x, 0), min(columns.y, last)), rows);
    }
    if columns.x < 0 {
        return Rectangle(vec2i(columns.x + i32(atlas.width), last), rows);
    }
    if columns.y > last {
        return Rectangle(vec2i(0, columns.y - i32(atlas.width)), rows);
    }
    return NOTHING;
}

fn origin_of_slot(slot: u32) -> vec2f {
    let place = vec2u(slot % atlas.columns, slot / atlas.columns);
    return vec2f(place * vec2u(atlas.width, atlas.height));
}

@vertex
fn cover(@builtin(vertex_index) vertex: u32, @location(0) slot: u32) -> Corner {
    var corner: Corner;
    corner.triangle = vertex / VERTICES_PER_TRIANGLE;
    corner.slot = slot;
    // Outside the clip volume unless the rectangle has pixels.
    corner.position = vec4f(2.0, 2.0, 0.0, 1.0);

    let pose = poses[slot];
    let triangle = triangles[corner.triangle];
    let rectangle = rectangle_of(
        point_in_lidar(pose, triangle.a.xyz),
        point_in_lidar(pose, triangle.b.xyz),
        point_in_lidar(pose, triangle.c.xyz),
        vertex % VERTICES_PER_TRIANGLE >= VERTICES_PER_RECTANGLE,
    );
    if rectangle.columns.x > rectangle.columns.y || rectangle.rows.x > rectangle.rows.y {
        return corner;
    }
    // Two triangles: corners 0 1 2 and 2 1 3 of the rectangle.
    let index = vertex % VERTICES_PER_RECTANGLE;
    let right = index == 1u || index == 4u || index == 5u;
    let lower = index == 2u || index == 3u || index == 5u;
    let pixel = origin_of_slot(slot) + vec2f(
        f32(select(rectangle.columns.x, rectangle.columns.y + 1, right)),
        f32(select(rectangle.rows.x, rectangle.rows.y + 1, lower)),
    );
    let place = pixel / atlas.atlas_size * 2.0 - 1.0;
    corner.position = vec4f(place.x, -place.y, 0.0, 1.0);
    return corner;
}

struct Fragment {
    // The bits of the range: float targets are not available on all devices.
    @location(0) range_bits: u32,
    // The nearest surface wins.
    @builtin(frag_depth) depth: f32,
}

@fragment
fn cast_pixel(corner: Corner) -> Fragment {
    let pixel = vec2u(corner.position.xy - origin_of_slot(corner.slot));
    let pose = poses[corner.slot];
    let direction = directions[pixel.y * atlas.width + pixel.x].xyz;
    let range_m = range_to(
        triangles[corner.triangle],
        pose,
        direction_in_map(pose, direction),
    );
    if range_m >= atlas.far_m {
        discard;
    }
    return Fragment(bitcast<u32>(range_m), range_m / atlas.far_m);
}
