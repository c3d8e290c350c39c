//! Laws of the inference, and comparison with scikit-fuzzy.

use super::super::defuzzification::MIN_TABULATED;
use super::*;

fn system(rules: &[&str], operators: Operators, inference: Inference) -> FuzzySystem {
    let rules: Vec<String> = rules.iter().map(|&rule| rule.to_owned()).collect();
    let sets = |names: [&str; 2]| {
        [
            (
                names[0].to_owned(),
                MembershipFunction::LeftShoulder([0.0, 1.0]),
            ),
            (
                names[1].to_owned(),
                MembershipFunction::RightShoulder([0.0, 1.0]),
            ),
        ]
        .into()
    };
    let vocabulary = [
        ("a".to_owned(), sets(["small", "large"])),
        ("b".to_owned(), sets(["small", "large"])),
        ("ground".to_owned(), sets(["low", "high"])),
    ]
    .into();
    FuzzySystem::new(
        &vocabulary,
        &rules,
        &["a", "b"],
        "ground",
        operators,
        inference,
    )
    .unwrap()
}

/// A line of the table: see scikit_fuzzy.py.
fn from_table(line: &str) -> (FuzzySystem, [f32; 2], f32) {
    let words: Vec<&str> = line.split(' ').collect();
    let numbers =
        |text: &str| -> Vec<f32> { text.split(',').map(|x| x.parse().unwrap()).collect() };
    let shape = |word: &str| {
        let (kind, corners) = word.split_once(':').unwrap();
        match (kind, &numbers(corners)[..]) {
            ("trapezoid", &[a, b, c, d]) => MembershipFunction::Trapezoid([a, b, c, d]),
            ("triangle", &[a, b, c]) => MembershipFunction::Triangle([a, b, c]),
            ("gaussian", &[mean, sigma]) => MembershipFunction::Gaussian([mean, sigma]),
            other => panic!("{other:?}"),
        }
    };
    let sets = |first: usize| {
        (0..3)
            .map(|set| (format!("s{set}"), shape(words[first + set])))
            .collect()
    };
    let vocabulary = [
        ("a".to_owned(), sets(1)),
        ("b".to_owned(), sets(4)),
        ("out".to_owned(), sets(7)),
    ]
    .into();
    let rules: Vec<String> = words[10..14]
        .iter()
        .map(|rule| {
            let parts: Vec<&str> = rule.split(',').collect();
            let [a, b, out, joint] = parts[..] else {
                panic!("{rule}")
            };
            format!("IF a IS s{a} {joint} b IS s{b} THEN out IS s{out}")
        })
        .collect();
    let operators = match words[0] {
        "product" => Operators::Product,
        _ => Operators::MinMax,
    };
    let system = FuzzySystem::new(
        &vocabulary,
        &rules,
        &["a", "b"],
        "out",
        operators,
        Inference::Mamdani,
    );
    let number = |index: usize| words[index].parse().unwrap();
    (system.unwrap(), [number(14), number(15)], number(16))
}

#[test]
fn random_systems_agree_with_scikit_fuzzy() {
    let table = include_str!("scikit_fuzzy.txt");
    assert!(table.lines().count() > 50);
    for line in table.lines() {
        let (system, inputs, expected) = from_table(line);
        let result = system.infer(&inputs);
        // The table integrates over 2000 intervals, this module over 64.
        assert!((result - expected).abs() < 2e-3, "{result} for {line}");
    }
}

const OPPOSITE: [&str; 2] = [
    "IF a IS small THEN ground IS low",
    "IF a IS large THEN ground IS high",
];

#[test]
fn tabulated_centroids_agree_with_the_integral() {
    let line = include_str!("scikit_fuzzy.txt").lines().next().unwrap();
    let (system, ..) = from_table(line);
    let defuzzifier = &system.defuzzifier;
    let mut worst: f32 = 0.0;
    for index in 0..1000 {
        let digit = |divisor: usize| (index / divisor % 10) as f32 / 9.0;
        let strengths = [digit(1), digit(10), digit(100)];
        if strengths.iter().any(|&strength| strength >= MIN_TABULATED) {
            worst = worst.max(
                (defuzzifier.interpolate(strengths) - defuzzifier.integrate(strengths.into_iter()))
                    .abs(),
            );
        }
    }
    assert!(worst < 6e-3, "{worst}");
}

#[test]
fn sugeno_inference_is_the_weighted_mean_of_the_peaks() {
    let system = system(&OPPOSITE, Operators::MinMax, Inference::Sugeno);
    for a in [0.0, 0.25, 0.5, 1.0] {
        assert!((system.infer(&[a, 0.3]) - a).abs() < 1e-6);
    }
}

#[test]
fn mirrored_sets_mirror_the_result() {
    for operators in [Operators::MinMax, Operators::Product] {
        let system = system(&OPPOSITE, operators, Inference::Mamdani);
        for a in [0.0, 0.1, 0.4, 0.9] {
            let sum = system.infer(&[a, 0.0]) + system.infer(&[1.0 - a, 0.0]);
            assert!((sum - 1.0).abs() < 1e-5, "{a}");
        }
    }
}

#[test]
fn the_result_is_one_half_where_no_rule_fires() {
    for inference in [Inference::Mamdani, Inference::Sugeno] {
        let system = system(&OPPOSITE[1..], Operators::MinMax, inference);
        assert_eq!(system.infer(&[0.0, 0.0]), 0.5);
        assert_eq!(system.infer(&[f32::NAN, 0.0]), 0.5);
    }
}

#[test]
fn and_and_or_follow_the_operators() {
    let strength = |joint: &str, operators| {
        let rule = format!("IF a IS large {joint} b IS NOT small THEN ground IS high");
        system(&[&rule], operators, Inference::Sugeno).firing_strengths(&[0.4, 0.5])[0]
    };
    assert_eq!(strength("AND", Operators::MinMax), 0.4);
    assert_eq!(strength("OR", Operators::MinMax), 0.5);
    assert_eq!(strength("AND", Operators::Product), 0.2);
    assert!((strength("OR", Operators::Product) - 0.7).abs() < 1e-6);
}

#[test]
fn and_binds_tighter_than_or() {
    let rule = "IF a IS large AND b IS large OR b IS small THEN ground IS high";
    let system = system(&[rule], Operators::MinMax, Inference::Sugeno);
    assert_eq!(system.firing_strengths(&[0.3, 0.0])[0], 1.0);
    assert_eq!(system.firing_strengths(&[0.3, 1.0])[0], 0.3);
}
