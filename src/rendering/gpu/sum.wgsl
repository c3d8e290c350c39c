// Sum over the threads of a work group, always in the same order. Prepended to `caster.wgsl`, `pixels.wgsl` and
// `reduce.wgsl`.
//
// Keep in sync with `layout.rs`: `LANES`.

const LANES: u32 = 64u;

var<workgroup> sums: array<f32, LANES>;

fn sum_over_lanes(lane: u32, term: f32) -> f32 {
    sums[lane] = term;
    workgroupBarrier();
    for (var half = LANES / 2u; half > 0u; half /= 2u) {
        if lane < half {
            sums[lane] += sums[lane + half];
        }
        workgroupBarrier();
    }
    return sums[0];
}
