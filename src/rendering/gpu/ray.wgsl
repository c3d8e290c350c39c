// Ray-triangle intersection. Prepended to `caster.wgsl` and `raster.wgsl`, among others, so that both find the same range to the last bit.
//
// Keep in sync with `layout.rs`: `FAR`, `Triangle`, `Pose`; and with `raycasting`: `NEAREST_M`.

// Range without a surface: WGSL has no infinity.
const FAR: f32 = 3.0e38;
// Surfaces nearer to the origin of a ray are not hit [m].
const NEAREST_M: f32 = 1.0e-4;

struct Triangle {
    a: vec4f,
    b: vec4f,
    c: vec4f,
}

// p_map = x_axis * p.x + y_axis * p.y + z_axis * p.z + origin + remainder, the origin on the lattice of maps
struct Pose {
    x_axis: vec4f,
    y_axis: vec4f,
    z_axis: vec4f,
    origin: vec4f,
    remainder: vec4f,
}

// From the origin of the lidar to a point, in the axes of the map; the first difference is exact on the lattice of maps.
fn from_origin(pose: Pose, point: vec3f) -> vec3f {
    return (point - pose.origin.xyz) - pose.remainder.xyz;
}

fn direction_in_map(pose: Pose, direction: vec3f) -> vec3f {
    return pose.x_axis.xyz * direction.x + pose.y_axis.xyz * direction.y
        + pose.z_axis.xyz * direction.z;
}

// Edge function: the side of the edge from p to q (as seen from the origin) on which the direction
// passes. The reversed edge gives exactly the negative, so that no ray slips between triangles.
fn side_of_edge(p: vec3f, q: vec3f, direction: vec3f) -> f32 {
    return dot(cross(p + q, q - p), direction);
}

// Towards its front, not of unit length.
fn normal_of(triangle: Triangle) -> vec3f {
    return cross(triangle.b.xyz - triangle.a.xyz, triangle.c.xyz - triangle.a.xyz);
}

// Distance along a unit direction to a triangle, from either of its sides; FAR where it is
// missed. The distance is that to the plane of the triangle.
fn range_to(triangle: Triangle, pose: Pose, direction: vec3f) -> f32 {
    let a = from_origin(pose, triangle.a.xyz);
    let b = from_origin(pose, triangle.b.xyz);
    let c = from_origin(pose, triangle.c.xyz);
    let u = side_of_edge(a, b, direction);
    let v = side_of_edge(b, c, direction);
    let w = side_of_edge(c, a, direction);
    if min(u, min(v, w)) < 0.0 && max(u, max(v, w)) > 0.0 {
        return FAR;
    }
    let normal = normal_of(triangle);
    let slope = dot(normal, direction);
    if slope == 0.0 {
        return FAR;
    }
    let range_m = dot(normal, a) / slope;
    return select(FAR, range_m, range_m > NEAREST_M);
}
