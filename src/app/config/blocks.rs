//! Checks of the blocks that stages own: what no formula and no loop of theirs can work with.
//!
//! The algorithms know nothing of YAML; here their values are refused before any work is done,
//! with the key as the user wrote it.

use super::check::{
    Check, Problem, at_least_one, nested, not_negative, positive, require, share, within,
};
use crate::ground::{FeatureConfig, FuzzyConfig, FuzzyGround, PcaGround, RuleError};
use crate::lidar::normals::NormalConfig;
use crate::localization::initialization::StartSpread;
use crate::localization::motion::{OdometryNoise, VelocityNoise};
use crate::localization::observation::ObservationConfig;
use crate::localization::panorama::PanoramaConfig;
use crate::localization::proposal::ProposalConfig;
use crate::localization::resampling::{KldConfig, ResamplingConfig};
use crate::localization::settings::TemperingConfig;
use crate::localization::vigilance::VigilanceConfig;
use crate::map::confidence::ConfidenceConfig;
use crate::map::visibility::VisibilityConfig;
use crate::meshing::PoissonConfig;
use crate::refinement::RefinementConfig;
use crate::refinement::smoothing::SmoothingConfig;
use crate::refinement::swarm::SwarmConfig;
use crate::registration::RegistrationConfig;

/// The box of the own car: x_min, x_max, y_min, y_max [m].
pub(super) fn own_car(key: &str, limits_m: [f32; 4]) -> Result<(), Problem> {
    let [x_min, x_max, y_min, y_max] = limits_m;
    require(
        limits_m.iter().all(|limit| limit.is_finite()) && x_min <= x_max && y_min <= y_max,
        key,
        format_args!("{limits_m:?}"),
        "it must be x_min, x_max, y_min, y_max with x_min up to x_max and y_min up to y_max; \
         [0, 0, 0, 0] leaves no point out",
    )
}

// build-map.

impl Check for PoissonConfig {
    fn check(&self) -> Result<(), Problem> {
        require(
            self.scale > 1.0 && self.scale <= 10.0,
            "scale",
            self.scale,
            "it is the cube over the points' box, greater than 1 and at most 10",
        )?;
        not_negative("point_weight", self.point_weight)?;
        positive("samples_per_node", self.samples_per_node)?;
        at_least_one("iterations", self.iterations)
    }
}

impl Check for NormalConfig {
    fn check(&self) -> Result<(), Problem> {
        positive("spacing_m", self.spacing_m)?;
        positive("tolerance_m", self.tolerance_m)?;
        not_negative("relative_tolerance", self.relative_tolerance)?;
        positive("beam_tolerance_m", self.beam_tolerance_m)?;
        require(
            self.min_support >= 2,
            "min_support",
            self.min_support,
            "a plane needs a pixel and 2 supporters or more",
        )?;
        share("min_share", self.min_share)?;
        share("min_incidence", self.min_incidence)
    }
}

impl Check for ConfidenceConfig {
    fn check(&self) -> Result<(), Problem> {
        not_negative("incidence_power", self.incidence_power)?;
        self.half_range_m
            .map_or(Ok(()), |half| positive("half_range_m", half))
    }
}

impl Check for VisibilityConfig {
    fn check(&self) -> Result<(), Problem> {
        at_least_one("point_voters", self.point_voters)?;
        not_negative("point_margin_m", self.point_margin_m)?;
        not_negative("point_margin_per_range", self.point_margin_per_range)?;
        at_least_one("point_votes", self.point_votes as usize)?;
        not_negative("triangle_margin_m", self.triangle_margin_m)?;
        not_negative("triangle_margin_per_range", self.triangle_margin_per_range)?;
        not_negative("crossing_m", self.crossing_m)?;
        not_negative("support_m", self.support_m)?;
        not_negative("support_range_m", self.support_range_m)?;
        at_least_one("triangle_votes", self.triangle_votes as usize)?;
        at_least_one("max_beams", self.max_beams)
    }
}

impl Check for FuzzyConfig {
    fn check(&self) -> Result<(), Problem> {
        nested("features", self.features.check())?;
        within("definitely", self.definitely, 0.5..=1.0)?;
        within("probably", self.probably, 0.5..=self.definitely)?;
        FuzzyGround::new(self.clone())
            .map(drop)
            .map_err(problem_of_rules)
    }
}

/// Tells the rule or the set that is wrong by its own key, so that its line is found.
fn problem_of_rules(error: RuleError) -> Problem {
    let (key, value, remedy) = match error {
        RuleError::Rule {
            number,
            rule,
            fault,
        } => (
            format!("rules[{number}]"),
            format!("`{rule}`"),
            fault.to_string(),
        ),
        RuleError::BadSet {
            variable,
            set,
            membership,
        } => (
            format!("variables.{variable}.{set}"),
            membership.to_string(),
            membership.law().to_owned(),
        ),
        RuleError::UnknownFeature { name, nearest } => (
            format!("variables.{name}"),
            "no feature".to_owned(),
            format!("the nearest is `{nearest}`"),
        ),
        RuleError::NoRules => ("rules".to_owned(), "empty".to_owned(), error.to_string()),
        RuleError::NoOutput { .. } | RuleError::TooManySets { .. } => (
            "variables".to_owned(),
            "not usable".to_owned(),
            error.to_string(),
        ),
    };
    Problem { key, value, remedy }
}

impl Check for FeatureConfig {
    fn check(&self) -> Result<(), Problem> {
        positive("spacing_m", self.spacing_m)?;
        not_negative("min_distance_m", self.min_distance_m)?;
        positive("terrain.step_m", self.terrain.step_m)?;
        not_negative("terrain.max_slope", self.terrain.max_slope)?;
        positive("terrain.max_jump_m", self.terrain.max_jump_m)?;
        positive("terrain.start_radius_m", self.terrain.start_radius_m)?;
        positive("terrain.max_low_slope_rad", self.terrain.max_low_slope_rad)
    }
}

impl Check for PcaGround {
    fn check(&self) -> Result<(), Problem> {
        share("min_cosine", self.min_cosine)?;
        require(
            self.max_height_m.is_finite(),
            "max_height_m",
            self.max_height_m,
            "it must be a height in the lidar frame, such as -1.1",
        )
    }
}

// localize.

impl Check for StartSpread {
    fn check(&self) -> Result<(), Problem> {
        not_negative("position_m", self.position_m)?;
        not_negative("heading_rad", self.heading_rad)
    }
}

impl Check for OdometryNoise {
    fn check(&self) -> Result<(), Problem> {
        not_negative("turn_rad", self.turn_rad)?;
        not_negative("drive_m", self.drive_m)?;
        not_negative("side_m", self.side_m)
    }
}

impl Check for VelocityNoise {
    fn check(&self) -> Result<(), Problem> {
        not_negative("speed_m_per_s", self.speed_m_per_s)?;
        not_negative("side_speed_m_per_s", self.side_speed_m_per_s)?;
        not_negative("turn_rate_rad_per_s", self.turn_rate_rad_per_s)?;
        not_negative("final_turn_rate_rad_per_s", self.final_turn_rate_rad_per_s)
    }
}

impl Check for ObservationConfig {
    fn check(&self) -> Result<(), Problem> {
        positive("reference_sigma_m", self.reference_sigma_m)?;
        positive("scale_m", self.scale_m)?;
        // A limit may be infinite: then it is none.
        above_zero("short_m", self.short_m)?;
        above_zero("long_m", self.long_m)?;
        above_zero("no_surface_m", self.no_surface_m)?;
        at_least_one("beams", self.beams)?;
        at_least_one("min_beams", self.min_beams)?;
        at_least_one("ray_budget", self.ray_budget)?;
        share("road_share", self.road_share)
    }
}

fn above_zero(key: &str, limit_m: f32) -> Result<(), Problem> {
    require(limit_m > 0.0, key, limit_m, "it must be greater than 0")
}

impl Check for TemperingConfig {
    fn check(&self) -> Result<(), Problem> {
        share("min_effective_fraction", self.min_effective_fraction)?;
        at_least_one("searching_rounds", self.searching_rounds)?;
        at_least_one("tracking_rounds", self.tracking_rounds)
    }
}

impl Check for ProposalConfig {
    fn check(&self) -> Result<(), Problem> {
        at_least_one("beams", self.beams)?;
        share("road_share", self.road_share)?;
        at_least_one("weighed_beams", self.weighed_beams)?;
        nested("registration", self.registration.check())?;
        require(
            self.widening >= 1.0 && self.widening.is_finite(),
            "widening",
            self.widening,
            "it must be 1 or greater",
        )?;
        positive("max_sigmas", self.max_sigmas)
    }
}

impl Check for ResamplingConfig {
    fn check(&self) -> Result<(), Problem> {
        share("min_effective_fraction", self.min_effective_fraction)?;
        not_negative("jitter", self.jitter)?;
        not_negative("max_jitter_m", self.max_jitter_m)?;
        not_negative("max_jitter_rad", self.max_jitter_rad)
    }
}

impl Check for KldConfig {
    fn check(&self) -> Result<(), Problem> {
        positive("max_distance", self.max_distance)?;
        not_negative("quantile", self.quantile)?;
        positive("bin_m", self.bin_m)?;
        positive("bin_rad", self.bin_rad)
    }
}

impl Check for VigilanceConfig {
    fn check(&self) -> Result<(), Problem> {
        positive("tolerance_m", self.tolerance_m)?;
        share("fast_rate", self.fast_rate)?;
        share("slow_rate", self.slow_rate)?;
        require(
            self.slow_rate <= self.fast_rate,
            "slow_rate",
            self.slow_rate,
            format!(
                "it must not be greater than fast_rate, which is {}",
                self.fast_rate
            ),
        )?;
        share("min_agreement", self.min_agreement)?;
        share("lost_fraction", self.lost_fraction)?;
        at_least_one("patience", self.patience)?;
        positive("max_spread_m", self.max_spread_m)
    }
}

impl Check for PanoramaConfig {
    fn check(&self) -> Result<(), Problem> {
        within("rows", self.rows, 1..=4096)?;
        within("columns", self.columns, 1..=65_536)?;
        require(
            self.lowest_rad.is_finite(),
            "lowest_rad",
            self.lowest_rad,
            "it must be an angle below the horizon, such as 0.12",
        )?;
        positive("limit_m", self.limit_m)?;
        within("coarse_step", self.coarse_step, 1..=self.columns)?;
        share("refined_share", self.refined_share)?;
        positive("scale_m", self.scale_m)
    }
}

// refine.

impl Check for RefinementConfig {
    fn check(&self) -> Result<(), Problem> {
        nested("swarm", self.swarm.check())?;
        at_least_one("swarm_beams", self.swarm_beams)?;
        nested("gauss_newton", self.gauss_newton.check())?;
        nested("smoothing", self.smoothing.check())?;
        not_negative("reach_sigmas", self.reach_sigmas)?;
        positive("min_reach_m", self.min_reach_m)?;
        positive("min_reach_rad", self.min_reach_rad)?;
        ordered("reach_m", self.min_reach_m, self.max_reach_m)?;
        ordered("reach_rad", self.min_reach_rad, self.max_reach_rad)?;
        positive("scale_m", self.scale_m)
    }
}

/// `min_<what>` up to `max_<what>`, which must be finite.
fn ordered(what: &str, least: f64, most: f64) -> Result<(), Problem> {
    require(
        most.is_finite() && least <= most,
        &format!("max_{what}"),
        most,
        format!("it must not be less than min_{what}, which is {least}"),
    )
}

impl Check for SwarmConfig {
    fn check(&self) -> Result<(), Problem> {
        at_least_one("candidates", self.candidates)?;
        at_least_one("iterations", self.iterations)?;
        not_negative("inertia", self.inertia)?;
        not_negative("final_inertia", self.final_inertia)?;
        not_negative("cognitive", self.cognitive)?;
        not_negative("social", self.social)?;
        positive("max_velocity", self.max_velocity)?;
        not_negative("tolerance", self.tolerance)
    }
}

impl Check for RegistrationConfig {
    fn check(&self) -> Result<(), Problem> {
        at_least_one("iterations", self.iterations)?;
        positive("kernel_m", self.kernel_m)?;
        not_negative("tolerance_m", self.tolerance_m)?;
        at_least_one("sectors", self.sectors)?;
        not_negative("map_error_m", self.map_error_m)
    }
}

impl Check for SmoothingConfig {
    fn check(&self) -> Result<(), Problem> {
        positive("odometry_ahead_m", self.odometry_ahead_m)?;
        positive("odometry_aside_m", self.odometry_aside_m)?;
        positive("odometry_turn_rad", self.odometry_turn_rad)?;
        positive("robust_sigmas", self.robust_sigmas)?;
        at_least_one("iterations", self.iterations)
    }
}
