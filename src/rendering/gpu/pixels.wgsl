// Costs of the pixels of drawn range images, compared with a measured image; one sum per image and work group.
// Dispatched by `raster.rs`.
//
// `ray.wgsl` is prepended to this text; `cost.wgsl` is prepended to this text; `sum.wgsl` is prepended to this text.
// Keep in sync with `layout.rs`: `Pixel`, `Comparison`, `BEAMS_PER_GROUP`.

const BEAMS_PER_GROUP: u32 = 256u;

// A pixel with a return.
struct Pixel {
    index: u32,
    range_m: f32,
}

struct Comparison {
    // Number of pixels with a return.
    pixels: u32,
    // Work groups per image.
    groups: u32,
    // Of one image [pixels].
    width: u32,
    height: u32,
    // Images side by side.
    columns: u32,
    // Pixels between rows of the atlas.
    stride: u32,
    // Surfaces up to `min_m` and from `max_m` on are not seen [m].
    min_m: f32,
    max_m: f32,
    // As in `RangeDifference` [m].
    short_m: f32,
    long_m: f32,
    no_surface_m: f32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> comparison: Comparison;
@group(0) @binding(1) var<storage, read> atlas: array<f32>;
@group(0) @binding(2) var<storage, read> pixels: array<Pixel>;
@group(0) @binding(3) var<storage, read_write> results: array<f32>;

fn cost_in(slot: u32, pixel: Pixel) -> f32 {
    let row = slot / comparison.columns * comparison.height + pixel.index / comparison.width;
    let column = slot % comparison.columns * comparison.width + pixel.index % comparison.width;
    let range_m = atlas[row * comparison.stride + column];
    let is_seen = range_m > comparison.min_m && range_m < comparison.max_m;
    let limits = Limits(comparison.short_m, comparison.long_m, comparison.no_surface_m);
    return cost(pixel.range_m, select(FAR, range_m, is_seen), limits);
}

@compute @workgroup_size(64)
fn compare_pixels(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) lane: u32,
) {
    let first = group.x * BEAMS_PER_GROUP + lane;
    let end = min(comparison.pixels, (group.x + 1u) * BEAMS_PER_GROUP);
    var sum = 0.0;
    for (var i = first; i < end; i += LANES) {
        sum += cost_in(group.y, pixels[i]);
    }
    let total = sum_over_lanes(lane, sum);
    if lane == 0u {
        results[group.y * comparison.groups + group.x] = total;
    }
}
