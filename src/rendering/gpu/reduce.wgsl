// Sums the costs of the work groups of a pose, one pose per work group, always in the same order.
// Dispatched by `sums.rs`.
//
// `sum.wgsl` is prepended to this text. Keep in sync with `layout.rs`: `Reduction`.

struct Reduction {
    // Numbers per pose.
    terms: u32,
    unused_0: u32,
    unused_1: u32,
    unused_2: u32,
}

@group(0) @binding(0) var<uniform> reduction: Reduction;
@group(0) @binding(1) var<storage, read> terms: array<f32>;
@group(0) @binding(2) var<storage, read_write> totals: array<f32>;

@compute @workgroup_size(64)
fn reduce(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let start = group.x * reduction.terms;
    var sum = 0.0;
    for (var i = lane; i < reduction.terms; i += LANES) {
        sum += terms[start + i];
    }
    let total = sum_over_lanes(lane, sum);
    if lane == 0u {
        totals[group.x] = total;
    }
}
