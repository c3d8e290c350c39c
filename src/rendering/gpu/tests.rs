//! What needs to look inside: batches, limits, a device that is lost.
//!
//! What is rendered is compared in `tests/renderer_parity.rs`. Without any adapter these tests
//! say that they did not run, unless `FPMCL_REQUIRE_GPU=1`.

use nalgebra::Vector3;

use super::batch_sizes::BatchSizes;
use super::*;

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
    match GpuRenderer::new(&[stairs()], Backend::Gpu, None) {
        Ok(renderer) => Some(renderer),
        Err(RenderError::NoAdapter) => {
            let required = std::env::var_os("FPMCL_REQUIRE_GPU").is_some_and(|value| value == "1");
            assert!(
                !required,
                "FPMCL_REQUIRE_GPU=1, and there is no graphics adapter"
            );
            eprintln!("not run: there is no graphics adapter");
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
    for method in [ImageMethod::Cast, ImageMethod::Draw] {
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
    let error = DeviceMap::upload(&renderer.gpu, &[stairs()]).err();
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
    let drawn = renderer.render_by(ImageMethod::Draw, &poses(1), &wide);
    assert!(matches!(drawn, Err(RenderError::DeviceRefused { .. })));
    assert_eq!(
        renderer.render(&poses(1), &wide).unwrap()[0].len(),
        wide.width
    );
}
