//! Names of keys: full ones, their last parts, and those of range-mcl.
//!
//! > A name is the key with that full name; else, with one of its parts replaced by [`ALIASES`], and else as it is, the
//! > key whose full name ends with it. Of several, the one whose block contains the others.
//!
//! So `seed`, `range_image.width` and `numParticles` are names of keys wherever these are in a configuration, and
//! `localizer.numParticles` as well.

/// Other parts of names: those of range-mcl, without units and blocks, and earlier ones of our own.
const ALIASES: [(&str, &str); 22] = [
    // range-mcl
    ("crop_x", "crop_x_m"),
    ("crop_y", "crop_y_m"),
    ("crop_z", "crop_z_m"),
    ("grid_res", "panorama.cell_m"),
    ("move_thres", "move_thres_m"),
    ("numParticles", "num_particles"),
    ("number_of_iterations", "smoothing_iterations"),
    ("plot_loc_results", "output.plots"),
    ("plot_loc_traj", "output.plots"),
    ("simplify_resolution", "simplify_resolution_m"),
    ("visualize", "output.plots"),
    ("voxel_size", "voxel_size_m"),
    ("yaw_sigma", "panorama.yaw_sigma_deg"),
    // Earlier names of our own.
    ("constant_velocity_noise", "constant_velocity"),
    ("ground_method", "ground.method"),
    ("ground_method", "method"),
    ("odometry", "motion.odometry"),
    ("odometry_noise", "localizer.motion"),
    ("range_image.has_rows", "has_rows"),
    ("unknown_velocity_noise", "unknown_velocity"),
    ("velocity_noise", "localizer.velocity"),
    ("vigilance", "tracking_loss"),
];

/// Keys of range-mcl that bound the memory of its graphics card.
const WITHOUT_EFFECT: [&str; 2] = ["range_image.max_instance", "range_image.render_instanced"];

/// Last parts of earlier keys whose values are fixed now.
const REMOVED: [&str; 12] = [
    "basin_m",
    "basin_rad",
    "freedom",
    "max_sigmas",
    "min_incidence",
    "minima",
    "period_s",
    "refined_share",
    "refinement.scale_m",
    "tracking_rounds",
    "weighed_beams",
    "widening",
];

/// Longer names stand for nothing, also of what a user names within a block [bytes].
const LONGEST_NAME: usize = 1000;

/// What a name stands for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Meaning {
    /// The full name of a key, or of one that would be in a known block.
    Key(String),
    /// A key that has no effect.
    Nothing,
    /// An earlier key, whose value is fixed now.
    Removed,
    /// None of the keys.
    Unknown,
    /// Several keys equally well.
    Ambiguous(Vec<String>),
}

/// The full names of the keys of a configuration.
pub(super) struct Names(pub Vec<String>);

impl Names {
    /// What a dotted name stands for: that of a key, or of something within one.
    pub(super) fn meaning(&self, name: &str) -> Meaning {
        if WITHOUT_EFFECT.contains(&name) {
            return Meaning::Nothing;
        }
        // The time grows with the square of the length.
        if name.len() > LONGEST_NAME {
            return Meaning::Unknown;
        }
        let is_it = |removed: &&str| {
            let before = name.strip_suffix(*removed);
            before.is_some_and(|before| before.is_empty() || before.ends_with('.'))
        };
        let dots = name.rmatch_indices('.').map(|(dot, _)| dot);
        for end in std::iter::once(name.len()).chain(dots) {
            match self.key(&name[..end]) {
                Meaning::Key(key) => return Meaning::Key(key + &name[end..]),
                Meaning::Unknown if REMOVED.iter().any(is_it) => return Meaning::Removed,
                Meaning::Unknown => (),
                other => return other,
            }
        }
        Meaning::Unknown
    }

    /// The known part of a full name, which may go on within a map.
    pub(super) fn known<'a>(&self, full: &'a str) -> &'a str {
        let dots = full.rmatch_indices('.').map(|(dot, _)| dot);
        let mut parts = std::iter::once(full.len()).chain(dots);
        let end = parts.find(|&end| self.0.iter().any(|key| *key == full[..end]));
        &full[..end.unwrap_or(0)]
    }

    /// Whether a name is that of a block of keys.
    pub(super) fn is_block(&self, name: &str) -> bool {
        let Meaning::Key(key) = self.meaning(name) else {
            return false;
        };
        let inner = key + ".";
        self.0.iter().any(|key| key.starts_with(&inner))
    }

    /// The key of a name.
    fn key(&self, name: &str) -> Meaning {
        if self.0.iter().any(|key| key == name) {
            return Meaning::Key(name.to_owned());
        }
        let dots = name.match_indices('.').map(|(dot, _)| dot + 1);
        for start in std::iter::once(0).chain(dots) {
            let (before, rest) = name.split_at(start);
            for (alias, other) in ALIASES {
                let tail = rest.strip_prefix(alias);
                let is_part = |tail: &&str| tail.is_empty() || tail.starts_with('.');
                let Some(tail) = tail.filter(is_part) else {
                    continue;
                };
                // A block of the key may be given before its other name.
                let block = other.split_inclusive('.').next().unwrap_or(other);
                let is_outer = |outer: &&str| outer.is_empty() || outer.ends_with('.');
                let outer = before.strip_suffix(block).filter(is_outer);
                let replaced = format!("{}{other}{tail}", outer.unwrap_or(before));
                match self.ending(&replaced) {
                    Meaning::Unknown => (),
                    found => return found,
                }
            }
        }
        self.ending(name)
    }

    /// The key whose name ends with these parts; of several, the one whose block contains the others.
    fn ending(&self, parts: &str) -> Meaning {
        let block = |key: &str| key.strip_suffix(parts).map(str::to_owned);
        let is_block = |block: &str| block.is_empty() || block.ends_with('.');
        let blocks = self.0.iter().filter_map(|key| block(key));
        let blocks: Vec<String> = blocks.filter(|block| is_block(block)).collect();
        let outermost = blocks
            .iter()
            .find(|outer| blocks.iter().all(|it| it.starts_with(*outer)));
        match outermost {
            Some(block) => Meaning::Key(format!("{block}{parts}")),
            None if blocks.is_empty() => Meaning::Unknown,
            None => {
                let keys = blocks.iter().map(|block| format!("{block}{parts}"));
                Meaning::Ambiguous(keys.collect())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn meaning(name: &str) -> Meaning {
        let keys = [
            "seed",
            "odometry",
            "tracker.seed",
            "tracker.localizer.num_particles",
            "tracker.localizer.tracking_loss",
            "tracker.localizer.tracking_loss.patience",
            "refinement.swarm.patience",
            "refinement.wide_search.swarm.patience",
            "refinement.swarm",
            "refinement.wide_search.swarm",
            "tracker.sensor.range_image",
            "tracker.sensor.has_rows",
            "tracker.localizer.motion",
            "tracker.localizer.panorama.cell_m",
        ];
        Names(keys.map(str::to_owned).into()).meaning(name)
    }

    fn key(name: &str) -> Meaning {
        Meaning::Key(name.to_owned())
    }

    #[test]
    fn a_full_name_comes_before_a_longer_one() {
        assert_eq!(meaning("seed"), key("seed"));
        assert_eq!(meaning("tracker.seed"), key("tracker.seed"));
        assert_eq!(meaning("odometry"), key("odometry"));
    }

    #[test]
    fn another_name_stands_for_its_key_with_and_without_the_block_of_the_key() {
        let rows = key("tracker.sensor.has_rows");
        assert_eq!(meaning("range_image.has_rows"), rows);
        assert_eq!(meaning("tracker.sensor.range_image.has_rows"), rows);
        let cell = key("tracker.localizer.panorama.cell_m");
        assert_eq!(meaning("grid_res"), cell);
        assert_eq!(meaning("panorama.grid_res"), cell);
        let noise = key("tracker.localizer.motion");
        assert_eq!(meaning("odometry_noise"), noise);
        assert_eq!(meaning("localizer.odometry_noise"), noise);
        assert_eq!(meaning("tracker.localizer.odometry_noise"), noise);
    }

    #[test]
    fn the_last_parts_are_a_name_of_the_outermost_key() {
        assert_eq!(
            meaning("num_particles"),
            key("tracker.localizer.num_particles")
        );
        assert_eq!(meaning("swarm.patience"), key("refinement.swarm.patience"));
        assert_eq!(meaning("articles"), Meaning::Unknown);
        let all = [
            "tracker.localizer.tracking_loss.patience",
            "refinement.swarm.patience",
            "refinement.wide_search.swarm.patience",
        ];
        assert_eq!(
            meaning("patience"),
            Meaning::Ambiguous(all.map(str::to_owned).into())
        );
    }

    #[test]
    fn aliases_replace_a_part_wherever_it_is() {
        assert_eq!(
            meaning("numParticles"),
            key("tracker.localizer.num_particles")
        );
        assert_eq!(
            meaning("vigilance.patience"),
            key("tracker.localizer.tracking_loss.patience")
        );
        assert_eq!(
            meaning("tracker.localizer.vigilance.patience"),
            key("tracker.localizer.tracking_loss.patience")
        );
        assert_eq!(
            meaning("localizer.numParticles"),
            key("tracker.localizer.num_particles")
        );
    }

    #[test]
    fn an_earlier_key_whose_value_is_fixed_is_known_as_such() {
        assert_eq!(meaning("minima"), Meaning::Removed);
        assert_eq!(meaning("refinement.minima"), Meaning::Removed);
        assert_eq!(meaning("minimum"), Meaning::Unknown);
    }

    #[test]
    fn a_name_of_a_thousand_characters_has_a_meaning_and_a_longer_one_none() {
        let inner = |length: usize| format!("range_image.{}", "x".repeat(length - 12));
        let full = format!("tracker.sensor.{}", inner(1000));
        assert_eq!(meaning(&inner(1000)), key(&full));
        assert_eq!(meaning(&inner(1001)), Meaning::Unknown);
    }

    #[test]
    fn what_is_within_a_known_block_has_its_name() {
        assert_eq!(
            meaning("range_image.widht"),
            key("tracker.sensor.range_image.widht")
        );
        assert_eq!(meaning("range_image.max_instance"), Meaning::Nothing);
    }
}
