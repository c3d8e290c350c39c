// Ray casting through a bounding volume hierarchy, nearer child first; ranges are written (`cast_rays`; with a minus where a
// surface is seen from behind) or compared with measured ones (`compare_beams`).
//
// `ray.wgsl` is prepended to this text; `cost.wgsl` is prepended to this text; `sum.wgsl` is prepended to this text.
// Keep in sync with `layout.rs`: `Node`, `Query`, `LEAF`, `BEAMS_PER_GROUP`, and the bits of a node reference; `STACK_SIZE` is replaced by
// `shaders.rs` with the depth of the hierarchy.

const STACK_SIZE: u32 = 64u;
const BEAMS_PER_GROUP: u32 = 256u;

// A node reference is the index of a node, or LEAF | number of triangles << 28 | first triangle.
const LEAF: u32 = 0x80000000u;

struct Node {
    left_min: vec3f,
    left: u32,
    left_max: vec3f,
    right: u32,
    right_min: vec3f,
    unused_0: u32,
    right_max: vec3f,
    unused_1: u32,
}

struct Query {
    // Number of rays or beams.
    rays: u32,
    // Work groups per pose.
    groups: u32,
    // Reference to the root.
    root: u32,
    // Surfaces up to this range hide what is behind them, but are not seen [m].
    min_m: f32,
    // Surfaces at this range or farther are not hit [m].
    far_m: f32,
    // As in `RangeDifference` [m].
    short_m: f32,
    long_m: f32,
    no_surface_m: f32,
}

@group(0) @binding(0) var<storage, read> nodes: array<Node>;
@group(0) @binding(1) var<storage, read> triangles: array<Triangle>;
@group(1) @binding(0) var<uniform> query: Query;
@group(1) @binding(1) var<storage, read> poses: array<Pose>;
// Direction in the lidar frame; then the index of its result, or the measured range [m].
@group(1) @binding(2) var<storage, read> rays: array<vec4f>;
@group(1) @binding(3) var<storage, read_write> results: array<f32>;

// Range at which a ray enters a box, FAR if it does not before `far_m`. The exit is enlarged by more
// than the rounding of divisions (2.5 units in the last place): a ray along a face enters the box.
fn entry(low: vec3f, high: vec3f, pose: Pose, inverse: vec3f, far_m: f32) -> f32 {
    let one = from_origin(pose, low) * inverse;
    let other = from_origin(pose, high) * inverse;
    let near = min(one, other);
    let far = max(one, other);
    let enters = max(max(near.x, near.y), max(near.z, 0.0));
    let leaves = min(min(far.x, far.y), far.z) * 1.000002;
    return select(FAR, enters, enters <= min(leaves, far_m));
}

// 1 / direction, finite.
fn inverse_of(direction: vec3f) -> vec3f {
    let tiny = vec3f(1.0e-20);
    return 1.0 / select(direction, tiny, abs(direction) < tiny);
}

struct Hit {
    // FAR without a triangle.
    range_m: f32,
    triangle: u32,
}

// The nearest surface before `far_m`; any that is at most `enough_m` away will do.
fn nearest(pose: Pose, direction: vec3f, far_m: f32, enough_m: f32) -> Hit {
    let inverse = inverse_of(direction);
    var best = Hit(far_m, 0u);
    var stack: array<u32, STACK_SIZE>;
    var stack_near: array<f32, STACK_SIZE>;
    var depth = 0u;
    var child = query.root;
    loop {
        if (child & LEAF) != 0u {
            let first = child & 0x0fffffffu;
            let end = first + ((child >> 28u) & 7u);
            for (var i = first; i < end; i++) {
                let range_m = range_to(triangles[i], pose, direction);
                if range_m < best.range_m {
                    best = Hit(range_m, i);
                }
            }
            if best.range_m <= enough_m {
                return best;
            }
        } else {
            let node = nodes[child];
            let left = entry(node.left_min, node.left_max, pose, inverse, best.range_m);
            let right = entry(node.right_min, node.right_max, pose, inverse, best.range_m);
            let left_first = left <= right;
            if min(left, right) < FAR {
                if max(left, right) < FAR {
                    stack[depth] = select(node.left, node.right, left_first);
                    stack_near[depth] = max(left, right);
                    depth++;
                }
                child = select(node.right, node.left, left_first);
                continue;
            }
        }
        // The next node that is entered before the nearest surface.
        var found = false;
        while depth > 0u && !found {
            depth--;
            found = stack_near[depth] < best.range_m;
        }
        if !found {
            break;
        }
        child = stack[depth];
    }
    if best.range_m >= far_m {
        best.range_m = FAR;
    }
    return best;
}

@compute @workgroup_size(64)
fn cast_rays(@builtin(global_invocation_id) id: vec3u) {
    if id.x >= query.rays {
        return;
    }
    let pose = poses[id.y];
    let ray = rays[id.x];
    let direction = direction_in_map(pose, ray.xyz);
    let hit = nearest(pose, direction, query.far_m, -1.0);
    let is_behind = hit.range_m < FAR && dot(normal_of(triangles[hit.triangle]), direction) > 0.0;
    results[id.y * query.rays + bitcast<u32>(ray.w)] = select(hit.range_m, -hit.range_m, is_behind);
}

// A ray is traced only as far as it can change the cost: a surface nearer than measured - long_m
// costs long_m at any range; one farther than measured + short_m costs short_m, and if no surface
// at all costs as much, it does not matter whether there is one. Which surface is the nearest matters always where one
// may be too near to be seen.
fn cost_of(pose: Pose, beam: vec4f) -> f32 {
    let measured_m = beam.w;
    let limits = Limits(query.short_m, query.long_m, query.no_surface_m);
    let nothing_is_short = min(measured_m, limits.no_surface_m) == limits.short_m;
    let far_m = select(query.far_m, min(query.far_m, measured_m + limits.short_m), nothing_is_short);
    let direction = direction_in_map(pose, beam.xyz);
    let enough_m = select(measured_m - limits.long_m, -1.0, query.min_m > 0.0);
    let range_m = nearest(pose, direction, far_m, enough_m).range_m;
    return cost(measured_m, select(FAR, range_m, range_m > query.min_m), limits);
}

@compute @workgroup_size(64)
fn compare_beams(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let first = group.x * BEAMS_PER_GROUP + lane;
    let end = min(query.rays, (group.x + 1u) * BEAMS_PER_GROUP);
    var sum = 0.0;
    for (var i = first; i < end; i += LANES) {
        sum += cost_of(poses[group.y], rays[i]);
    }
    let total = sum_over_lanes(lane, sum);
    if lane == 0u {
        results[group.y * query.groups + group.x] = total;
    }
}
