// Cost of the difference of two ranges. Prepended to `caster.wgsl` and `pixels.wgsl`.
//
// `ray.wgsl` is prepended to this text. Keep in sync with `layout.rs`: `FAR`; and with `RangeDifference::cost` in `mod.rs`
// of `rendering`.

struct Limits {
    short_m: f32,
    long_m: f32,
    no_surface_m: f32,
}

fn cost(measured_m: f32, rendered_m: f32, limits: Limits) -> f32 {
    if rendered_m >= FAR {
        return min(measured_m, limits.no_surface_m);
    }
    if rendered_m >= measured_m {
        return min(rendered_m - measured_m, limits.short_m);
    }
    return min(measured_m - rendered_m, limits.long_m);
}
