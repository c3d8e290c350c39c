//! Laws of the classifiers in synthetic worlds.

use glam::Vec3;

use super::scenes_for_tests::{Sensor, Surface, cuboid};
use super::*;

const SENSORS: [Sensor; 2] = [Sensor::SIXTY_FOUR, Sensor::THIRTY_TWO];

fn fuzzy() -> [FuzzyGround; 2] {
    [FuzzyConfig::default(), FuzzyConfig::three_features()]
        .map(|config| FuzzyGround::new(config).unwrap())
}

/// Share of the returns that are classified as ground, among those that `selected` accepts.
fn share_of_ground(
    classifier: &dyn GroundClassifier,
    sensor: &Sensor,
    surfaces: &[Surface],
    selected: impl Fn(usize, Vec3) -> bool,
) -> f64 {
    let (points, hits) = sensor.scan(surfaces);
    let confidences = classifier.ground_confidence(&points);
    let (mut positives, mut all) = (0, 0);
    for ((&point, &hit), &confidence) in points.iter().zip(&hits).zip(&confidences) {
        if selected(hit, point) && point.truncate().length() > 2.5 {
            all += 1;
            positives += u32::from(confidence > 0.5);
        }
    }
    assert!(all > 50, "{all} points are too few");
    f64::from(positives) / f64::from(all)
}

#[test]
fn a_flat_plane_is_ground() {
    for sensor in SENSORS {
        for classifier in fuzzy() {
            let flat = [sensor.ground(|_, _| 0.0)];
            let share = share_of_ground(&classifier, &sensor, &flat, |_, _| true);
            assert!(share > 0.99, "{share}");
        }
    }
}

#[test]
fn slopes_of_5_10_and_15_percent_are_ground_uphill_and_downhill() {
    for sensor in SENSORS {
        for grade in [0.05, 0.1, 0.15, -0.1] {
            // The car stands on the level part, 5 m before the slope.
            let slope = [sensor.ground(move |x, _| grade * (x - 5.0).max(0.0))];
            let share = share_of_ground(&fuzzy()[0], &sensor, &slope, |_, point| point.x > 6.0);
            assert!(share > 0.93, "{grade}, {} beams: {share}", sensor.beams);
            // The car stands on the slope itself.
            let slope = [sensor.ground(move |x, _| grade * x)];
            let share = share_of_ground(&fuzzy()[0], &sensor, &slope, |_, _| true);
            assert!(share > 0.93, "{grade}, {} beams: {share}", sensor.beams);
        }
    }
}

#[test]
fn a_crest_is_ground() {
    for sensor in SENSORS {
        let crest = [sensor.ground(|x, _| 0.1 * (20.0 - (x - 20.0).abs()).max(0.0))];
        let share = share_of_ground(&fuzzy()[0], &sensor, &crest, |_, point| point.x > 2.0);
        assert!(share > 0.95, "{share}");
    }
}

#[test]
fn a_wall_is_not_ground_but_the_road_in_front_of_it_is() {
    for sensor in SENSORS {
        for classifier in fuzzy() {
            let scene = [
                sensor.ground(|_, _| 0.0),
                cuboid(Vec3::new(-30.0, 8.0, -2.0), Vec3::new(40.0, 9.0, 5.0)),
            ];
            let over_foot = -sensor.height_m + 0.15;
            let wall = share_of_ground(&classifier, &sensor, &scene, |hit, point| {
                hit == 1 && point.z > over_foot
            });
            let road = share_of_ground(&classifier, &sensor, &scene, |hit, _| hit == 0);
            assert!(wall < 0.02, "{wall}");
            assert!(road > 0.97, "{road}");
        }
    }
}

#[test]
fn the_top_of_a_kerb_is_ground() {
    for sensor in SENSORS {
        let kerb = [sensor.ground(|_, y| if y > 4.0 { 0.14 } else { 0.0 })];
        let share = share_of_ground(&fuzzy()[0], &sensor, &kerb, |_, point| point.y > 4.3);
        assert!(share > 0.95, "{share}");
    }
}

#[test]
fn neither_the_side_nor_the_roof_of_a_car_is_ground() {
    for sensor in SENSORS {
        let road_m = -sensor.height_m;
        let scene = [
            sensor.ground(|_, _| 0.0),
            // Body and roof, the roof just below the sensor.
            cuboid(
                Vec3::new(6.0, 2.5, road_m),
                Vec3::new(10.5, 4.3, road_m + 0.9),
            ),
            cuboid(
                Vec3::new(7.5, 2.6, road_m),
                Vec3::new(10.0, 4.2, road_m + 1.45),
            ),
        ];
        let is_car = |hit, point: Vec3| hit > 0 && point.z > road_m + 0.2;
        let [four, three] = fuzzy().map(|fuzzy| share_of_ground(&fuzzy, &sensor, &scene, is_car));
        assert!(four < 0.05, "{four}");
        // A roof is as flat as a road; only its height distinguishes it.
        assert!(three < 0.15, "{three}");
    }
}

#[test]
fn fuzzy_rules_find_the_ground_of_a_slope_where_one_plane_does_not() {
    let sensor = Sensor::SIXTY_FOUR;
    let slope = [sensor.ground(|x, _| 0.15 * (x - 8.0).max(0.0))];
    let on_slope = |_, point: Vec3| point.x > 12.0;
    let share =
        |classifier: &dyn GroundClassifier| share_of_ground(classifier, &sensor, &slope, on_slope);
    assert!(share(&fuzzy()[0]) > 0.95);
    assert!(share(&RansacGround::default()) < 0.5);
}

#[test]
fn principal_components_find_the_road_from_any_height() {
    for height_m in [0.6, 1.2, 2.8] {
        let sensor = Sensor {
            height_m,
            ..Sensor::SIXTY_FOUR
        };
        let roof_m = 0.9 - height_m;
        let scene = [
            sensor.ground(|_, _| 0.0),
            cuboid(Vec3::new(6.0, 2.5, -height_m), Vec3::new(10.0, 9.0, roof_m)),
        ];
        let pca = PcaGround::default();
        for classifier in [pca, pca.mounted(Some(f64::from(height_m)))] {
            let road = share_of_ground(&classifier, &sensor, &scene, |hit, _| hit == 0);
            let is_roof = |hit, point: Vec3| hit == 1 && point.z > roof_m - 0.1;
            let roof = share_of_ground(&classifier, &sensor, &scene, is_roof);
            assert!(road > 0.95, "{height_m}: {road}");
            assert!(height_m < 1.0 || roof < 0.01, "{height_m}: {roof}");
        }
    }
}

#[test]
fn empty_scans_and_points_that_are_not_finite_are_not_ground() {
    let classifiers: [&dyn GroundClassifier; 5] = [
        &fuzzy()[0],
        &fuzzy()[1],
        &PcaGround::default(),
        &RansacGround::default(),
        &ReportRule,
    ];
    let bad = [
        vec![Vec3::NAN; 50],
        vec![Vec3::INFINITY; 50],
        vec![Vec3::ZERO; 50],
        vec![Vec3::new(f32::NAN, 1.0, -1.7); 50],
        vec![Vec3::new(1e30, 1.0, -1.7); 50],
    ];
    for classifier in classifiers {
        assert!(classifier.ground_confidence(&[]).is_empty());
        for points in &bad {
            let confidences = classifier.ground_confidence(points);
            assert_eq!(confidences.len(), points.len());
            assert!(confidences.iter().all(|c| (0.0..=1.0).contains(c)));
            if !points[0].is_finite() {
                assert!(confidences.iter().all(|&c| c == 0.0));
            }
        }
    }
}

#[test]
fn invalid_points_do_not_affect_the_others() {
    let sensor = Sensor::SIXTY_FOUR;
    let (points, _) = sensor.scan(&[sensor.ground(|_, _| 0.0)]);
    let mut spoiled = points.clone();
    for number in 0..40 {
        spoiled.insert(number * 500, Vec3::new(f32::NAN, 3.0, f32::INFINITY));
    }
    for classifier in fuzzy() {
        let clean = classifier.ground_confidence(&points);
        let mut confidences = classifier.ground_confidence(&spoiled);
        for number in (0..40).rev() {
            assert_eq!(confidences.remove(number * 500), 0.0);
        }
        assert_eq!(clean, confidences);
    }
}

#[test]
fn an_explanation_contains_the_confidence_and_the_rules_that_fired() {
    let [classifier, _] = fuzzy();
    let road = Features {
        slope_deg: 2.0,
        height_variance_m: 0.02,
        curvature_deg: 3.0,
        height_m: 0.0,
        relief_m: 0.05,
    };
    let explanation = classifier.explain(&road);
    assert_eq!(explanation.confidence, classifier.confidence(&road));
    assert_eq!(explanation.verdict, "definitely ground");
    let (strength, rule) = &explanation.fired[0];
    assert_eq!(*strength, 1.0);
    assert!(rule.ends_with("IS high"), "{rule}");
    let text = explanation.to_string();
    assert!(
        text.contains("slope") && text.contains("definitely ground"),
        "{text}"
    );

    let roof = Features {
        height_m: 1.4,
        relief_m: 1.4,
        ..road
    };
    let explanation = classifier.explain(&roof);
    assert_eq!(explanation.verdict, "definitely not ground");
}

#[test]
fn verdicts_are_symmetric_about_one_half() {
    let [classifier, _] = fuzzy();
    let words = [0.95, 0.7, 0.5, 0.3, 0.05].map(|confidence| classifier.verdict(confidence));
    let expected = [
        "definitely ground",
        "probably ground",
        "uncertain",
        "probably not ground",
        "definitely not ground",
    ];
    assert_eq!(words, expected);
}

#[test]
fn a_configuration_round_trips_through_yaml_and_typing_errors_are_reported() {
    let config = FuzzyConfig::three_features();
    let text = serde_yaml::to_string(&config).unwrap();
    let back: FuzzyConfig = serde_yaml::from_str(&text).unwrap();
    assert_eq!(back, config);

    let broken = FuzzyConfig {
        rules: vec!["IF slop IS gentle THEN ground IS high".to_owned()],
        ..config
    };
    let message = FuzzyGround::new(broken).unwrap_err().to_string();
    assert!(message.contains("nearest is `slope`"), "{message}");
    let mistyped: Result<FuzzyConfig, _> = serde_yaml::from_str("rulez: []\n");
    assert!(mistyped.unwrap_err().to_string().contains("rulez"));
}

#[test]
fn the_chart_range_of_a_variable_contains_the_core_of_every_set() {
    for config in [FuzzyConfig::default(), FuzzyConfig::three_features()] {
        for (variable, sets) in &config.variables {
            let (from, to) = config.chart_range(variable);
            for (set, function) in sets {
                let degree = |step| function.degree(from + 0.01 * step as f32 * (to - from));
                assert!((0..=100).any(|step| degree(step) > 0.9), "{set}");
            }
        }
    }
}
