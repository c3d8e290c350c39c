//! What needs to look inside: batches, limits, a device that is lost.
//!
//! What is rendered is compared in `tests/renderer_parity.rs`. Without any adapter these tests
//! say that they did not run, unless `FPMCL_REQUIRE_GPU=1`.

use std::cell::RefCell;

use nalgebra::Vector3;

use super::batch_sizes::BatchSizes;
use super::*;
use crate::geometry::TriangleMesh;
use crate::raycasting::{Scene, TileError};

/// A floor of 30 m by 30 m with steps up.
fn stairs() -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for i in 0..30_u8 {
        for j in 0..30_u8 {
            let corner = Vec3::new(
                f32::from(i) - 15.0,
                f32::from(j) - 15.0,
                f32::from(i % 5) * 0.2,
            );
            let first = mesh.vertices.len() as u32;
            let square = [Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y];
            mesh.vertices.extend(square.map(|offset| corner + offset));
            mesh.triangles.push([first, first + 1, first + 2]);
            mesh.triangles.push([first, first + 2, first + 3]);
        }
    }
    mesh
}

fn renderer() -> Option<GpuRenderer> {
    match GpuRenderer::new(
        Arc::new(Scene::of_tiles(&[stairs()])),
        (Backend::Gpu, RenderingMethod::Auto),
        MemoryBudget::default(),
    ) {
        Ok(renderer) => Some(renderer),
        Err(RenderError::NoAdapter) => {
            let required = std::env::var_os("FPMCL_REQUIRE_GPU").is_some_and(|value| value == "1");
            assert!(
                !required,
                "FPMCL_REQUIRE_GPU=1, and there is no graphics adapter"
            );
            crate::skips_for_tests::skipped("there is no graphics adapter");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

fn model() -> LidarModel {
    LidarModel {
        height: 8,
        width: 32,
        ..LidarModel::default()
    }
}

fn poses(count: u16) -> Vec<Pose3> {
    (0..count)
        .map(|i| {
            let i = f64::from(i);
            Pose3::new(
                Vector3::new(8.0 * (0.7 * i).sin(), 8.0 * (0.3 * i).cos(), 2.5),
                Vector3::new(0.0, 0.0, i),
            )
        })
        .collect()
}

#[test]
fn an_image_is_the_same_whichever_batch_it_was_in() {
    let Some(mut renderer) = renderer() else {
        return;
    };
    // The last batch is not full.
    let poses = poses(50);
    for method in [ImageMethod::Cast, ImageMethod::Raster] {
        let together = renderer.render_by(method, &poses, &model()).unwrap();
        assert!(together.iter().flatten().any(|range_m| range_m.is_finite()));
        let sizes = renderer.gpu.batch_sizes;
        renderer.gpu.batch_sizes = BatchSizes {
            ranges: 1000,
            directions: 100,
            poses: 7,
            images: 8,
            ..sizes
        };
        assert_eq!(
            renderer.render_by(method, &poses, &model()).unwrap(),
            together
        );
        renderer.gpu.batch_sizes = sizes;
        for (pose, image) in poses.iter().zip(&together) {
            let alone = renderer.render_by(method, std::slice::from_ref(pose), &model());
            assert_eq!(alone.unwrap()[0], *image, "{method:?}");
        }
    }
}

#[test]
fn costs_do_not_depend_on_how_the_poses_are_cut_into_batches() {
    let Some(mut renderer) = renderer() else {
        return;
    };
    let poses = poses(40);
    let beams: Vec<Beam> = (model().directions().into_iter().cycle().take(700))
        .zip(0_u16..)
        .map(|(direction, i)| Beam {
            direction,
            range_m: 3.0 + f32::from(i % 23),
        })
        .collect();
    let difference = RangeDifference::truncated(2.0);
    let costs = renderer.compare(&poses, &beams, &difference).unwrap();
    renderer.gpu.batch_sizes.poses = 3;
    assert_eq!(
        renderer.compare(&poses, &beams, &difference).unwrap(),
        costs
    );
    // Beams in parts are added up in another order.
    renderer.gpu.batch_sizes.directions = 256;
    let in_parts = renderer.compare(&poses, &beams, &difference).unwrap();
    for (one, other) in costs.iter().zip(in_parts) {
        assert!((one - other).abs() < 1e-5, "{one} {other}");
    }
}

#[test]
fn a_map_that_the_device_cannot_bind_is_an_error_that_says_how_large_it_is() {
    let Some(mut renderer) = renderer() else {
        return;
    };
    renderer.gpu.limits.max_storage_buffer_binding_size = 1 << 16;
    let hierarchy = two_level::tests::build(&[stairs()]);
    let error = device_map::DeviceMap::upload(&renderer.gpu, hierarchy).err();
    assert!(
        matches!(
            error,
            Some(RenderError::MapTooLarge {
                needed: 86_400,
                limit: 65_536
            })
        ),
        "{error:?}"
    );
}

#[test]
fn a_lost_device_is_an_error_and_stays_one() {
    let Some(renderer) = renderer() else {
        return;
    };
    let poses = poses(3);
    assert!(renderer.render(&poses, &model()).is_ok());
    renderer.gpu.device.destroy();
    for _ in 0..2 {
        let error = renderer.render(&poses, &model()).unwrap_err();
        assert!(matches!(error, RenderError::DeviceLost { .. }), "{error}");
    }
}

#[test]
fn what_the_device_refuses_is_an_error_and_no_panic() {
    let Some(renderer) = renderer() else {
        return;
    };
    // Ranges must lie in a buffer that can be copied from.
    let wrong = renderer
        .gpu
        .buffer("wrong", 64, wgpu::BufferUsages::STORAGE);
    let mut encoder = renderer
        .gpu
        .device
        .create_command_encoder(&Default::default());
    encoder.copy_buffer_to_buffer(&wrong, 0, &renderer.gpu.staging(64), 0, 64);
    renderer.gpu.queue.submit([encoder.finish()]);
    let error = renderer.render(&poses(1), &model()).unwrap_err();
    assert!(
        matches!(error, RenderError::DeviceRefused { .. }),
        "{error}"
    );
}

#[test]
fn an_image_that_fits_no_texture_can_be_cast_but_not_drawn() {
    let Some(renderer) = renderer() else {
        return;
    };
    let wide = LidarModel {
        height: 1,
        width: renderer.gpu.limits.max_texture_dimension_2d as usize + 1,
        ..model()
    };
    let drawn = renderer.render_by(ImageMethod::Raster, &poses(1), &wide);
    assert!(matches!(drawn, Err(RenderError::DeviceRefused { .. })));
    assert_eq!(
        renderer.render(&poses(1), &wide).unwrap()[0].len(),
        wide.width
    );
}

#[test]
fn several_batches_are_started_before_the_first_is_read() {
    let Some(renderer) = renderer() else {
        return;
    };
    let gpu = &renderer.gpu;
    let order = RefCell::new(Vec::new());
    let start = |batch: &usize| {
        order.borrow_mut().push(("start", *batch));
        let encoder = gpu.device.create_command_encoder(&Default::default());
        sums::read_back(gpu, encoder, &sums::results(gpu, 64), 64)
    };
    let finish = |batch, _| order.borrow_mut().push(("finish", batch));
    batches::run(gpu, 0..5, start, finish).unwrap();
    let expected = [
        ("start", 0),
        ("start", 1),
        ("start", 2),
        ("finish", 0),
        ("start", 3),
        ("finish", 1),
        ("start", 4),
        ("finish", 2),
        ("finish", 3),
        ("finish", 4),
    ];
    assert_eq!(*order.borrow(), expected);
}

#[test]
fn images_are_compared_by_the_faster_method_also_where_they_fit_no_texture() {
    let Some(renderer) = renderer() else {
        return;
    };
    let wide = LidarModel {
        height: 1,
        width: renderer.gpu.limits.max_texture_dimension_2d as usize + 1,
        ..model()
    };
    for (model, methods) in [
        (wide, &[ImageMethod::Cast][..]),
        (model(), &[ImageMethod::Cast, ImageMethod::Raster]),
    ] {
        let scan = renderer.render(&poses(1), &model).unwrap().remove(0);
        let scan = RangeImage::from_ranges(scan, &model);
        let unlimited = RangeDifference::UNLIMITED;
        let faster = renderer.faster_method(&poses(3), &scan, &unlimited);
        assert!(methods.contains(&faster.unwrap()));
    }
    let scan = renderer.render(&poses(1), &model()).unwrap().remove(0);
    let scan = RangeImage::from_ranges(scan, &model());
    let compare =
        |count| renderer.compare_images(&poses(count), &scan, &RangeDifference::UNLIMITED);
    assert!(compare(0).unwrap().is_empty() && renderer.method.get().is_none());
    assert_eq!(compare(3).unwrap()[0], 0.0);
    assert!(renderer.method.get().is_some());
}

/// A street of tiles that are 40 m apart.
fn street(count: u8) -> Scene<TileError> {
    let tile = |number| {
        let mut tile = stairs();
        for vertex in &mut tile.vertices {
            *vertex += Vec3::new(40.0 * f32::from(number), 0.0, 0.1 * f32::from(number));
        }
        tile
    };
    let tiles: Vec<TriangleMesh> = (0..count).map(tile).collect();
    Scene::of_tiles(&tiles)
}

#[test]
fn tiles_come_and_go_with_the_poses_and_nothing_looks_different() {
    /// Those within reach of a car are four, with those ahead seven; those within reach of a square of 200 m are seven.
    const FEW_TILES: u64 = 5;
    const TILES: u64 = 8;
    let Some(renderer) = renderer() else {
        return;
    };
    drop(renderer);
    let street = Arc::new(street(20));
    let request = (Backend::Gpu, RenderingMethod::Auto);
    let open = || GpuRenderer::new(street.clone(), request, MemoryBudget::default()).unwrap();
    let (mut whole, mut part) = (open(), open());
    whole.map.set_budget(u64::MAX);
    let tile_bytes = stairs().triangles.len() as u64 * resident::TRIANGLE_BYTES;
    part.map.set_budget(FEW_TILES * tile_bytes);
    let model = LidarModel {
        max_range: 50.0,
        ..model()
    };
    let at = |x: f64| Pose3::translation(x, 1.25, 3.0 + 0.0025 * x);
    let mut seen = std::collections::BTreeSet::new();
    for step in 0..16_u8 {
        let poses = [at(50.0 * f64::from(step)), at(50.0 * f64::from(step) + 5.0)];
        for method in [ImageMethod::Cast, ImageMethod::Raster] {
            let [expected, images] = [&whole, &part].map(|r| r.render_by(method, &poses, &model));
            let images = images.unwrap();
            assert!(images == expected.unwrap(), "{step} {method:?}");
            assert!(images.iter().flatten().any(|range_m| range_m.is_finite()));
        }
        let there = part.map.tiles_there();
        assert!(there.len() as u64 <= FEW_TILES, "{there:?}");
        seen.extend(there);
    }
    assert_eq!(seen.len(), 20);
    assert!(!part.map.tiles_there().contains(&0));

    // Poses along the whole street are more than the device holds: they are rendered part by part.
    part.map.set_budget(TILES * tile_bytes);
    let poses: Vec<Pose3> = (0..30_u8).map(|i| at(26.0 * f64::from(29 - i))).collect();
    let directions = model.directions();
    let [expected, rows] = [&whole, &part].map(|r| r.cast(&poses, &directions, 20.0).unwrap());
    assert!(rows == expected);
    let beams: Vec<Beam> = std::iter::zip(directions, &rows[0])
        .filter(|(_, range_m)| range_m.is_finite())
        .map(|(direction, &range_m)| Beam { direction, range_m })
        .collect();
    let near = RangeDifference::truncated(0.5);
    let [expected, costs] = [&whole, &part].map(|r| r.compare(&poses, &beams, &near).unwrap());
    assert!(costs == expected);
    assert!(part.map.tiles_there().len() as u64 <= TILES);

    // What reaches the whole map is left to the CPU.
    let far = RangeDifference::UNLIMITED;
    let there = part.map.tiles_there();
    let [expected, costs] = [&whole, &part].map(|r| r.compare(&poses, &beams, &far).unwrap());
    for (cost, expected) in costs.iter().zip(&expected) {
        assert!((cost - expected).abs() < 1e-3, "{cost} {expected}");
    }
    assert_eq!(part.map.tiles_there(), there);
}
